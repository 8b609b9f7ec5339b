"""What FFmpeg says is caught, and what is harmless is not told."""

import av

from pipeline.footage.ffmpeg_messages import caught_messages


def test_errors_are_caught_and_the_harmless_ones_left_out(capfd):
    with caught_messages() as said:
        av.logging.log(av.logging.ERROR, "ffv1", "  slice CRC mismatch\n")
        av.logging.log(av.logging.ERROR, "h264", "mmco: unref short failure")
        av.logging.log(av.logging.ERROR, "h264", "co located POCs unavailable")
        av.logging.log(av.logging.INFO, "h264", "all is well")
        assert said == []  # filled at the end
    assert said == ["slice CRC mismatch"]
    assert capfd.readouterr().err == ""


def test_the_same_message_twice_is_told_twice():
    with caught_messages() as said:
        for _ in range(2):
            av.logging.log(av.logging.ERROR, "ffv1", "slice CRC mismatch")
    assert said == 2 * ["slice CRC mismatch"]
