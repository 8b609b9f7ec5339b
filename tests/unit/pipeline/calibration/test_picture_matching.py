"""Frames of recordings, videos and folders matched to the pictures of a sequence."""

import cv2
import numpy as np
import pytest
from support.slide_shows import InMemory, as_jpeg, film
from support.video_files import encode

from pipeline.calibration.captures import CapturedFolder
from pipeline.calibration.color_chart import chart_codes, chart_sequence
from pipeline.calibration.multishot import multishot_codes, multishot_sequence
from pipeline.calibration.picture_matching import find_captures, find_poses, match_pictures
from pipeline.calibration.radiometry import radiometry_codes, radiometry_sequence
from pipeline.errors import CalibrationError, FootageError
from pipeline.output.range_image import write_png
from pipeline.recording.recorder import Recorder
from tikernels.raw.pixel_format import PixelFormat

HEIGHT, WIDTH = 90, 120
PROJECTOR_PX = (192, 144)
CROSSTALK = np.array([[0.58, 0.063, 0.013], [0.076, 0.54, 0.1], [0.013, 0.126, 0.57]])
RADIOMETRY, CHART = radiometry_sequence(PROJECTOR_PX), chart_sequence(PROJECTOR_PX)
GEOMETRY = multishot_sequence(PROJECTOR_PX)
Y, X = np.mgrid[:HEIGHT, :WIDTH]


def fields(sequence, transfer=1.0):
    """Return what a camera sees of plain fields on a target that fills two thirds of its picture, of 255 levels."""
    codes = chart_codes if sequence.kind == "chart" else radiometry_codes
    shade = (1 - 0.3 * (X / WIDTH - 0.5) ** 2) * (np.abs(X - WIDTH / 2) < WIDTH / 3)
    lights = [shade[..., None] * (CROSSTALK @ (0.9 * codes(name) ** 2.2)) + 0.03 for name in sequence.names]
    return [255 * light**transfer for light in lights]


def pose(number, gain=0.8):
    """Return what a camera sees of the pictures on a board, each pose elsewhere."""
    left, top = np.random.default_rng(number).integers(0, 30, 2)
    squares = ((X + left) // 12 + (Y + top) // 12) % 2
    board = np.where((np.abs(X - 35 - left) < 35) & (np.abs(Y - 30 - top) < 28), 0.1 + 0.7 * squares, 0.15)
    row, column = np.minimum(top + Y, 143), np.minimum(left + X, 191)
    lights = [gain * multishot_codes(name, PROJECTOR_PX)[row, column] ** 2 + 0.03 for name in GEOMETRY.names]
    return [255 * board[..., None] * light for light in lights]


def others(seed, count):
    """Return pictures of anything else, as desktops."""
    rng = np.random.default_rng(seed)
    return [cv2.resize(rng.uniform(5, 150, (4, 5, 3)), (WIDTH, HEIGHT), interpolation=0) for _ in range(count)]


def captured(pictures):
    rng = np.random.default_rng(5)
    return [np.clip(np.rint(p + rng.standard_normal(p.shape)), 0, 255).astype(np.uint8) for p in pictures]


@pytest.mark.parametrize("sequence", [RADIOMETRY, CHART], ids=lambda sequence: sequence.kind)
def test_one_frame_per_picture(sequence):
    images = captured(fields(sequence))
    (found,) = match_pictures(InMemory(images), sequence)
    assert list(found) == list(sequence.names) and len(found) == len(images)
    for name, image in zip(sequence.names, images, strict=True):
        np.testing.assert_array_equal(found[name], image)


def test_one_frame_per_picture_of_several_poses():
    images = captured([*pose(1), *pose(2), *pose(3)])
    found = match_pictures(InMemory(images), GEOMETRY)
    assert [list(captures.numbers.values()) for captures in found] == np.arange(36).reshape(3, 12).tolist()


SHOWS = {
    "plain": {},
    "light's own noise": {"shot": 2.5},
    "short": {"dwell": (3.5, 5.0)},
    "at once": {"readout": 0.0, "exposure": 0.3, "dwell": (2.5, 4.0)},
    "long": {"dwell": (8.0, 25.0)},
    "flicker": {"drift": 0.003},
    "no noise": {"noise": 0.0},
}


def shown(found, alone, sequence):
    """Return which pictures of a film the captures show."""
    return [[alone[captures.numbers[name]] for name in sequence.names] for captures in found]


@pytest.mark.parametrize("show", SHOWS.values(), ids=SHOWS)
def test_fields_in_a_slide_show(show):
    for seed, (sequence, before, after) in enumerate([(RADIOMETRY, 2, 1), (RADIOMETRY, 0, 0), (CHART, 1, 2)]):
        pictures = [*others(seed, before), *fields(sequence), *others(seed + 9, after)]
        frames, alone = film(pictures, seed, **show)
        found = match_pictures(InMemory(frames), sequence)
        assert shown(found, alone, sequence) == [list(range(before, before + len(sequence.names)))]


@pytest.mark.parametrize("show", SHOWS.values(), ids=SHOWS)
def test_poses_in_a_slide_show(show):
    """Between two of them the board is carried past under the white field, and put down twice."""
    first, second = pose(1), pose(2)
    carried = [pose(k)[0] for k in (5, 6)]
    pictures = [*others(1, 2), *first, *carried, *second, *others(2, 1)]
    frames, alone = film(pictures, 3, **show)
    found = match_pictures(InMemory(frames), GEOMETRY)
    assert shown(found, alone, GEOMETRY) == [list(range(2, 14)), list(range(16, 28))]


@pytest.mark.parametrize("carried", [40, 250])
def test_a_board_that_is_carried_most_of_the_time(carried):
    """Its moves are more frequent than what noise changes."""
    first, second = pose(1), pose(2)
    on_the_way = [np.roll(first[0], 3 * k, axis=k // 10 % 2) for k in range(1, carried)]
    frames, alone = film(first, 1)
    moving, _ = film([first[11], *on_the_way, second[0]], 2, dwell=(1.0, 1.0))
    later, alone_later = film(second, 3)
    found = match_pictures(InMemory([*frames, *moving, *later]), GEOMETRY)
    alone += [-1] * len(moving) + [12 + which if which >= 0 else -1 for which in alone_later]
    assert shown(found, alone, GEOMETRY) == [list(range(12)), list(range(12, 24))]


def test_grey_pictures_are_refused_with_what_to_do(tmp_path):
    for number in range(4):
        write_png(tmp_path / f"{number}.png", np.full((9, 9), 9, np.uint8))
    with pytest.raises(FootageError, match="holds grey pictures: convert mosaics to RGB, or record them as Zarr"):
        find_captures(tmp_path, CHART)


def test_a_webcams_jpeg():
    encoded = fields(RADIOMETRY, transfer=1 / 2.2)
    for sequence, pictures in ((RADIOMETRY, encoded), (GEOMETRY, pose(1))):
        frames, alone = film([*others(1, 1), *pictures, *others(2, 1)], 4, noise=1.5, spoil=as_jpeg)
        found = match_pictures(InMemory(frames), sequence)
        assert shown(found, alone, sequence) == [list(range(1, 1 + len(pictures)))]


def test_a_picture_that_something_passes_is_one():
    """Three frames of a hand before the camera divide a picture, and a frame of it is damaged."""
    frames, alone = film(fields(RADIOMETRY), 6, dwell=(10.0, 12.0))
    at = alone.index(20) + 4
    for number in range(at, at + 3):
        frames[number] = frames[number] // (number - at + 2)
    frames[at - 2] = None
    (found,) = match_pictures(InMemory(frames), RADIOMETRY)
    assert shown([found], alone, RADIOMETRY) == [list(range(33))]
    assert found.numbers[RADIOMETRY.names[20]] not in range(at - 2, at + 3)


@pytest.mark.parametrize("filmed", [False, True], ids=["alone", "filmed"])
def test_fields_that_are_missing_double_or_out_of_order_are_refused(filmed):
    """Whatever makes up for their number: another picture before, behind, or the neighbour again in other light."""
    pictures, other = fields(RADIOMETRY), others(1, 2)
    for k in range(1, 33, 1 if not filmed else 5):
        fewer = [*pictures[:k], *pictures[k + 1 :]]
        again = [0.95 * pictures[0], *fewer]  # two blacks, as a lamp is switched on
        swapped = [*pictures[: k - 1], pictures[k], pictures[k - 1], *pictures[k + 1 :]]
        for number, wrong in enumerate((fewer, again, swapped, [other[0], *fewer], [*fewer, other[1]])):
            frames = film([*other, *wrong], k)[0] if filmed else captured(wrong)
            with pytest.raises(CalibrationError, match=r"film \(\d+ frames\): \d+ still .* no 33 in a row") as raised:
                match_pictures(InMemory(frames), RADIOMETRY)
                pytest.fail(f"picture {k} is wrong ({number}), and nobody has noticed")
            assert "\n" not in str(raised.value)


@pytest.mark.parametrize("filmed", [False, True], ids=["alone", "filmed"])
def test_pictures_of_a_pose_that_are_missing_are_refused(filmed):
    """A pose without its white or its black is none; of one without another picture it is said."""
    good, bad = pose(1), pose(2)
    for k in range(12):
        for wrong in ([*bad[:k], *bad[k + 1 :]], [*bad[:k], *bad[k + 1 :], others(k, 1)[0]]):
            pictures = [*good, *wrong]
            frames, alone = film(pictures, k) if filmed else (captured(pictures), list(range(len(pictures))))
            if filmed and k < 2:
                found = match_pictures(InMemory(frames), GEOMETRY)
                assert shown(found, alone, GEOMETRY) == [list(range(12))]
                continue
            with pytest.raises(CalibrationError, match=r"begin with white and black, but are not the 12|none is white"):
                match_pictures(InMemory(frames), GEOMETRY)
                pytest.fail(f"picture {k} is missing, and nobody has noticed")


def test_what_is_wrong_is_said():
    with pytest.raises(CalibrationError, match="film holds no frame that can be read"):
        match_pictures(InMemory([None, None]), CHART)
    with pytest.raises(
        CalibrationError, match=r"film \(40 frames, 1 more cannot be used: it is damaged\): .* no 33 in"
    ):
        match_pictures(InMemory([None, *captured([pose(1)[0]] * 40)]), RADIOMETRY)
    frames, alone = film([*pose(1)[:9], *others(1, 1)], 2)
    first = alone.index(0)
    with pytest.raises(CalibrationError, match=f"the 10 still pictures from frame {first} on begin"):
        match_pictures(InMemory(frames), GEOMETRY)


@pytest.mark.parametrize(
    "format, top, developed",
    [
        (PixelFormat("rgb", 16), 65535, np.uint16),
        (PixelFormat("rgb", 12), 4095, np.float32),
        (PixelFormat("bayer", 12, bayer="grbg"), 4095, np.float32),
        (PixelFormat("rgb", 32), 1.0, np.float32),
    ],
    ids=["16 bits", "12 bits", "mosaic", "floats"],
)
def test_kinds_of_pixels(cpu, format, top, developed):
    """The full scale of developed frames is their type's, whatever the camera's."""
    frames, alone = film([*others(1, 1), *fields(CHART), *others(2, 1)], 1)
    images = [(frame / 255 * top).astype(format.dtype) for frame in frames]
    if format.layout == "bayer":
        mosaic = np.array([[1, 0], [2, 1]])
        images = [np.take_along_axis(i, mosaic[Y % 2, X % 2][..., None], axis=2)[..., 0] for i in images]
    found = match_pictures(InMemory(images, format), CHART)
    assert shown(found, alone, CHART) == [[1, 2, 3, 4]]
    red = found[0]["1-red"]
    assert red.dtype == developed
    full = 65535 if developed == np.uint16 else 1.0
    inner = np.s_[10:-10, WIDTH // 3 : 2 * WIDTH // 3]
    expected = fields(CHART)[1][inner].mean(axis=(0, 1)) / 255
    np.testing.assert_allclose(red[inner].mean(axis=(0, 1)) / full, expected, atol=0.003)


def test_names_of_ones_own_are_in_natural_order(tmp_path):
    images = captured(fields(CHART))
    for number, image in zip((2, 9, 10, 11), images, strict=True):
        write_png(tmp_path / f"IMG_{number}.png", image)
    ((name, found),) = find_captures(tmp_path, CHART)
    assert name == tmp_path.name
    for number, image in enumerate(images):
        np.testing.assert_array_equal(found[CHART.names[number]], image)


def test_names_of_the_sequence_go_before_what_is_seen(tmp_path):
    for name, image in zip(CHART.names, captured(fields(CHART))[::-1], strict=True):
        write_png(tmp_path / f"{name}.png", image)
    ((_, found),) = find_captures(tmp_path, CHART)
    assert isinstance(found, CapturedFolder)
    (tmp_path / "2-green.png").unlink()
    with pytest.raises(CalibrationError, match=r"lacks the capture 2-green\.png"):
        find_captures(tmp_path, CHART)


def test_poses_in_every_kind_of_place(tmp_path):
    """A recording of two in the folder of a capture, a video, and pictures under the names of the sequence."""
    (tmp_path / "b10").mkdir()
    for name, image in zip(GEOMETRY.names, captured(pose(4)), strict=True):
        write_png(tmp_path / "b10" / f"{name}.png", image)
    (tmp_path / "b2").mkdir()
    with Recorder(tmp_path / "b2" / "recording.zarr", PixelFormat("rgb")) as recorder:
        frames, alone = film([*pose(1), *pose(2)], 1)
        for frame in frames:
            recorder.add(frame)
    planes = [(np.ascontiguousarray(frame.mean(axis=2).astype(np.uint8)),) for frame in captured(pose(3))]
    flat = np.full((HEIGHT, WIDTH), 128, np.uint8)
    encode(tmp_path / "a.mkv", [(luma, flat, flat) for (luma,) in planes], "ffv1", "yuv444p")
    (tmp_path / "notes.txt").touch()
    found = list(find_poses(tmp_path, GEOMETRY))
    ends = [(alone.index(0), alone.index(11)), (alone.index(12), alone.index(23))]
    assert [name for name, _ in found][::3] == ["a.mkv", "b10"]
    for number, (name, (first, last)) in enumerate(zip([name for name, _ in found][1:3], ends, strict=True), start=1):
        assert name.startswith(f"pose {number} of b2 (frames ")
        numbers = [int(word.rstrip(")")) for word in name.split()[5::2]]
        assert first <= numbers[0] < first + 9 and last <= numbers[1] < last + 9
    alone_recorded = list(find_poses(tmp_path / "b2", GEOMETRY))
    assert [name for name, _ in alone_recorded] == [name for name, _ in found][1:3]
    with pytest.raises(FootageError, match="cannot read"):
        list(find_poses(tmp_path / "none", GEOMETRY))
