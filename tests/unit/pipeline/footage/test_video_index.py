"""Where to enter a video so that a frame comes out whole, and which frames a damaged one spoils."""

import pytest

from pipeline.footage.video_index import VideoIndex

# As in the file: a key frame, a frame predicted from it, one between both in time; and the same again, in an open
# group, whose last frame lies before its key frame in time and is predicted from both sides of it.
NUMBERS = (0, 2, 1, 4, 6, 3, 5)
KEYS = (0, 3)


def index(numbers=NUMBERS, keys=KEYS, stamps=NUMBERS):
    return VideoIndex(stamps, stamps, "pts", numbers, keys)


@pytest.mark.parametrize(("number", "position"), [(0, 0), (1, 0), (2, 0), (3, 0), (4, 3), (5, 3), (6, 3)])
def test_decoding_begins_at_the_last_key_frame_shown_before(number, position):
    assert index().position_before(number) == position


@pytest.mark.parametrize(("position", "first"), [(0, 0), (1, 0), (2, 0), (3, 3), (4, 3), (6, 3), (5, 0)])
def test_a_frame_before_its_key_frame_in_time_needs_the_group_before(position, first):
    assert index().first_needed(position) == first


def test_every_frame_stands_alone():
    alone = index(range(7), range(7), range(7))
    assert alone.intra_only
    assert [alone.position_before(number) for number in range(7)] == list(range(7))
    assert not index().intra_only


def test_without_stamps_only_the_frames_before_tell_which_one_it_is():
    assert index(range(7), range(7), ()).position_before(5) == 0
    assert not index(range(7), range(7), ()).intra_only
