"""A recording's frames have checksums."""

import io
import zlib

import av
import pytest
from support.numbered_frames import RGB8, add, held

from pipeline.errors import DamageError
from pipeline.footage.opening import open_source
from pipeline.footage.recording_clusters import check_cluster, cluster
from pipeline.footage.source import BadFrame
from pipeline.recording.recorder import Recorder

CODED = bytes(range(40))
BLOCK_AT = cluster(0, CODED).index(CODED) - 4


def test_the_checksum_is_that_of_ebml():
    """Of all that follows it in the cluster, the lowest byte first (RFC 8794, 11.3.1)."""
    content = cluster(7, CODED)
    checked = content[4 + 8 + 1 + 8 + 4 :]
    assert content[4 + 8 : 4 + 8 + 1] == b"\xbf"
    assert int.from_bytes(content[21:25], "little") == zlib.crc32(checked)
    check_cluster(io.BytesIO(b"before" + content), 6 + BLOCK_AT, len(CODED))


def test_every_wrong_bit_is_noticed():
    content = cluster(7, CODED)
    for bit in range(8 * len(content)):
        damaged = bytearray(content)
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(DamageError, match="its checksum is another one"):
            check_cluster(io.BytesIO(damaged), BLOCK_AT, len(CODED))


def test_what_ends_before():
    with pytest.raises(DamageError):
        check_cluster(io.BytesIO(cluster(7, CODED)[:-1]), BLOCK_AT, len(CODED))
    with pytest.raises(DamageError):
        check_cluster(io.BytesIO(b""), 3, 10)


def test_a_damaged_frame_of_a_recording_is_named_and_the_others_stay(tmp_path):
    with Recorder(tmp_path / "a.mkv", RGB8) as recorder:
        add(recorder, 9)
    assert held(tmp_path / "a.mkv") == 9
    with av.open(str(tmp_path / "a.mkv")) as container:
        places = [packet.pos for packet in container.demux(video=0) if packet.size]
    content = bytearray((tmp_path / "a.mkv").read_bytes())
    content[places[3] - 28] ^= 1  # of the checksum itself: FFmpeg sees nothing
    content[places[6] + 300] ^= 1
    (tmp_path / "a.mkv").write_bytes(content)
    source = open_source(tmp_path / "a.mkv")
    bad = {frame.number: frame.reason for frame in source.frames() if isinstance(frame, BadFrame)}
    source.close()
    assert bad.keys() == {3, 6} and "checksum" in bad[3]
