"""What a recording says of itself."""

from fractions import Fraction

import pytest

from pipeline.errors import FootageError
from pipeline.footage.recording_tags import RecordingTags, rate_of
from pipeline.footage.source import StoredAs
from tikernels import ShapeError

TAGS = RecordingTags(Fraction(30000, 1001), "srgb", "grbg", 12)


def test_tags_come_back_whatever_case_a_container_gives_them():
    written = TAGS.write()
    assert written["COLORPHASE_RATE"] == "30000/1001" and all(isinstance(value, str) for value in written.values())
    assert RecordingTags.read(written) == TAGS
    assert RecordingTags.read({key.lower(): value for key, value in written.items()}) == TAGS
    plain = RecordingTags(Fraction(30), None, None, 8)
    assert RecordingTags.read(plain.write()) == plain


def test_another_video_has_none():
    assert RecordingTags.read({"ENCODER": "Lavf"}) is None


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"COLORPHASE_RECORDING": "2"}, "version 2, this program reads 1: update it"),
        ({"COLORPHASE_RATE": "fast"}, "rate 'fast' is no fraction"),
        ({"COLORPHASE_BITS": "many"}, "remux it with all its tags"),
        ({"COLORPHASE_BITS": "9" * 5000}, r"bits '9{40}' is no number of bits\): remux"),
        ({"COLORPHASE_RATE": "9" * 5000}, r"rate '9{40}' is no fraction\): remux"),
    ],
)
def test_tags_that_are_wrong(changed, message):
    with pytest.raises(FootageError, match=message):
        RecordingTags.read({**TAGS.write(), **changed})


def test_a_tag_that_is_missing():
    written = TAGS.write()
    del written["COLORPHASE_BITS"]
    with pytest.raises(FootageError, match="remux it with all its tags"):
        RecordingTags.read(written)


@pytest.mark.parametrize("text", ["1e999999999", "-1", "1/0", "0x10", "", "1/2/3"])
def test_a_rate_is_a_fraction_of_two_plain_numbers(text):
    with pytest.raises(ValueError, match="no fraction"):
        rate_of(text)


def test_rates_that_milliseconds_cannot_count():
    for rate_hz in (0, 501):
        with pytest.raises(ShapeError, match="give one above 0 and up to 500"):
            RecordingTags(Fraction(rate_hz), None, None, 8)


@pytest.mark.parametrize("rate_hz", [Fraction(30000, 1001), Fraction(500), Fraction(7)])
def test_every_frame_has_a_stamp_of_its_own_and_the_length_tells_how_many(rate_hz):
    tags = RecordingTags(rate_hz, None, None, 8)
    stamps = [tags.stamp(number) for number in range(5000)]
    assert len(set(stamps)) == 5000
    for n_frames in (1, 2, 999, 5000):
        assert tags.n_frames(1000 * tags.stamp(n_frames)) == n_frames


def test_the_user_knows_better():
    assert TAGS.completing(StoredAs(bayer="rggb", siting="left")) == StoredAs("rggb", 12, "left")
