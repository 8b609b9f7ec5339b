"""What is fixed in a GenICam camera, in which order, and what is said of the rest; on a node map of our own."""

import numpy as np
import pytest
from support.genicam_node_map import Feature, NodeMap, choice

from hardware.camera.genicam import (
    FrameNumbers,
    buffers_for,
    choose,
    copy_image,
    sensor_temperature_c,
    set_up,
    storable,
    wait_until_ready,
)
from hardware.camera.opened_camera import Setup
from hardware.errors import CameraError, RigError
from hardware.protocols import CameraLimits, FrameFormat, SensorPart
from hardware.settings import CameraSettings

SETTINGS = CameraSettings(driver="aravis", exposure_s=2e-3, trigger="Line1")


def camera(**others):
    """Return a camera with nearly everything, all of it left in the worst state by whoever used it before."""
    features = {
        "AcquisitionMode": choice("SingleFrame", "Continuous"),
        "AcquisitionFrameRateEnable": Feature(True),
        "PixelFormat": choice("Mono8", "BayerRG8", "BayerRG12", "BayerRG12p", "RGB8"),
        "BinningHorizontal": Feature(2),
        "ReverseX": Feature(True),
        "Width": Feature(640, bounds=(16, 1920), step=4),
        "Height": Feature(480, bounds=(16, 1200), step=2),
        "OffsetX": Feature(8, step=4),
        "OffsetY": Feature(8, step=1),
        "ExposureAuto": choice("Continuous", "Off"),
        "GainAuto": choice("Continuous", "Off"),
        "BalanceWhiteAuto": choice("Once", "Off"),
        "GammaEnable": Feature(True),
        "Gamma": Feature(0.45),
        "LUTEnable": Feature(True),
        "ColorTransformationEnable": Feature(True),
        "SharpnessEnable": Feature(True),
        "BalanceRatioSelector": choice("Red", "Green", "Blue"),
        "BalanceRatio": Feature(1.7),
        "ExposureMode": choice("TriggerWidth", "Timed"),
        "ExposureTime": Feature(10.0, bounds=(20.0, 1e6)),
        "GainSelector": choice("DigitalAll", "AnalogAll"),
        "Gain": Feature(6.0, bounds=(0.0, 24.0)),
        "LineSelector": choice("Line2", "Line1"),
        "LineMode": choice("Output", "Input"),
        "LineInverter": Feature(True),
        "LineSource": choice("UserOutput1", "ExposureActive"),
        "TriggerSelector": choice("AcquisitionStart", "FrameStart"),
        "TriggerMode": choice("On", "Off"),
        "TriggerSource": choice("Software", "Line1", "Line2"),
        "TriggerActivation": choice("FallingEdge", "RisingEdge"),
        "TriggerDelay": Feature(3.0),
        "ResultingFrameRate": Feature(50.0),
    }
    return NodeMap({**features, **others})


def without(*names):
    node_map = camera()
    for name in names:
        del node_map.features[name]
    return node_map


def test_order():
    """The exact calls: the old trigger and rate limit first, automatics before what they choose, the trigger last."""
    node_map = camera()
    setup = set_up(node_map, SETTINGS.model_copy(update={"strobe_line": "Line2", "gain_db": 3.0}))
    assert node_map.script == [
        "AcquisitionMode=Continuous",
        "TriggerSelector=AcquisitionStart",
        "TriggerMode=Off",
        "TriggerSelector=FrameStart",
        "TriggerMode=Off",
        "AcquisitionFrameRateEnable=False",
        "PixelFormat=BayerRG12",
        "BinningHorizontal=1",
        "ReverseX=False",
        "OffsetX=0",
        "Width=1920",
        "OffsetX=0",
        "OffsetY=0",
        "Height=1200",
        "OffsetY=0",
        "ExposureAuto=Off",
        "GainAuto=Off",
        "BalanceWhiteAuto=Off",
        "ColorTransformationEnable=False",
        "SharpnessEnable=False",
        "GammaEnable=False",
        "LUTEnable=False",
        "BalanceRatioSelector=Red",
        "BalanceRatio=1.0",
        "BalanceRatioSelector=Green",
        "BalanceRatioSelector=Blue",
        "ExposureMode=Timed",
        "ExposureTime=2000.0",
        "GainSelector=DigitalAll",
        "Gain=0.0",
        "GainSelector=AnalogAll",
        "Gain=3.0",
        "LineSelector=Line1",
        "LineMode=Input",
        "LineInverter=False",
        "LineSelector=Line2",
        "LineMode=Output",
        "LineInverter=False",
        "LineSource=ExposureActive",
        "TriggerSelector=FrameStart",
        "TriggerSource=Line1",
        "TriggerActivation=RisingEdge",
        "TriggerDelay=0.0",
        "TriggerMode=On",
    ]
    assert setup == Setup(
        CameraLimits(
            (1920, 1200),
            FrameFormat("bayer", 12, "rggb"),
            (20e-6, 1.0),
            min_period_s=0.02,
            triggered=True,
            sensor=SensorPart(sensor_px=(1920, 1200), offset_px=(0, 0), binning=(1, 1)),
        ),
        exposure_s=2e-3,
        unlocked=(),
        swapped=False,
    )


def test_by_software():
    node_map = camera()
    set_up(node_map, SETTINGS.model_copy(update={"trigger": "software"}))
    assert node_map.script[-4:] == [
        "TriggerSelector=FrameStart",
        "TriggerSource=Software",
        "TriggerDelay=0.0",
        "TriggerMode=On",
    ]


def test_part_in_the_middle():
    """The offset is even, or the mosaic would begin with another colour."""
    node_map = camera()
    setup = set_up(node_map, SETTINGS.model_copy(update={"size_px": (640, 482)}))
    assert setup.limits.size_px == (640, 482)
    assert (node_map.get("OffsetX"), node_map.get("OffsetY")) == (640, 358)
    assert setup.limits.sensor == SensorPart(sensor_px=(1920, 1200), offset_px=(640, 358), binning=(1, 1))


def test_the_part_of_the_sensor_is_what_the_camera_reads_back_or_unknown():
    small = SETTINGS.model_copy(update={"size_px": (640, 482)})
    stays = camera(OffsetX=Feature(8, step=4, ignores_changes=True))
    assert set_up(stays, small).limits.sensor == SensorPart(sensor_px=(1920, 1200), offset_px=(8, 358), binning=(1, 1))
    assert set_up(without("OffsetX"), small).limits.sensor is None
    assert set_up(without("OffsetX"), SETTINGS).limits.sensor.offset_px == (0, 0)


@pytest.mark.parametrize(
    "name, feature, said",
    [
        ("ExposureAuto", Feature("Continuous", locked=True), "ExposureAuto stays Continuous, so the camera chooses"),
        ("BalanceWhiteAuto", Feature("Continuous", ignores_changes=True), "BalanceWhiteAuto stays Continuous"),
        (
            "GammaEnable",
            Feature(True, ignores_changes=True),
            "GammaEnable stays True, so levels are not proportional to light",
        ),
        ("BalanceRatio", Feature(1.7, locked=True), "BalanceRatio stays 1.7, so red is scaled"),
        ("Gain", Feature(6.0, bounds=(0.0, 24.0), ignores_changes=True), "the gain is 6 dB, not 0: write gain_db = 6"),
    ],
)
def test_what_stays_is_said(name, feature, said):
    found = set_up(camera(**{name: feature}), SETTINGS).unlocked
    assert any(sentence.startswith(said) for sentence in found), found
    assert not any("\n" in sentence for sentence in found)


def test_nearly_one_is_one():
    """Fixed-point ratios come back as 0.9998."""
    ratio = Feature(0.9998, ignores_changes=True)
    assert set_up(camera(BalanceRatio=ratio), SETTINGS).unlocked == ()


def test_gain_that_cannot_be_known():
    raw = without("Gain", "GainSelector")
    assert set_up(raw, SETTINGS).unlocked[0].startswith("its gain cannot be read back")
    raw = without("Gain", "GainSelector")
    raw.features["GainRaw"] = Feature(9, bounds=(4, 63))
    assert set_up(raw, SETTINGS).unlocked == ("its gain has no unit: it was set to its least, 4",)
    with pytest.raises(RigError, match="cannot be set in dB; leave gain_db out"):
        set_up(raw, SETTINGS.model_copy(update={"gain_db": 1.0}))


@pytest.mark.parametrize(
    "change, said",
    [
        ({"exposure_s": 5.0}, r"exposure_s is 5 s: this camera exposes for 2e-05 to 1 s"),
        ({"gain_db": 30.0}, r"gain_db is 30: this camera's gain is 0 to 24 dB"),
        ({"pixel_format": "BayerGB8"}, r"no pixel_format BayerGB8 .* it has BayerRG8, BayerRG12, RGB8"),
        ({"pixel_format": "BayerRG12p"}, r"no pixel_format BayerRG12p that can be stored"),
        ({"pixel_format": "Mono8"}, r"no pixel_format Mono8"),
        ({"size_px": (642, 480)}, r"width of 642: this camera's is 16 to 1920 px in steps of 4"),
        ({"size_px": (640, 2000)}, r"height of 2000: this camera's is 16 to 1200 px"),
        ({"trigger": "Line3"}, r"no trigger Line3; it has Software, Line1, Line2"),
        ({"strobe_line": "Line5"}, r"no strobe_line Line5; it has Line2, Line1"),
        ({"strobe_line": "Line1"}, r"strobe_line and trigger are both Line1"),
    ],
)
def test_impossible_settings(change, said):
    with pytest.raises(RigError, match=said) as refused:
        set_up(camera(), SETTINGS.model_copy(update=change))
    assert "\n" not in str(refused.value)


def test_lines_that_cannot():
    with pytest.raises(RigError, match="Line2 cannot be an output"):
        set_up(camera(LineMode=choice("Input")), SETTINGS.model_copy(update={"strobe_line": "Line2"}))
    with pytest.raises(RigError, match="cannot report exposures, only UserOutput1"):
        set_up(camera(LineSource=choice("UserOutput1")), SETTINGS.model_copy(update={"strobe_line": "Line2"}))
    with pytest.raises(RigError, match="it has no lines at all"):
        set_up(without("LineSelector"), SETTINGS.model_copy(update={"strobe_line": "Line2"}))


def test_cameras_of_no_use():
    with pytest.raises(CameraError, match="no colour format that can be stored, only Mono8, Mono12: take a colour"):
        set_up(camera(PixelFormat=choice("Mono8", "Mono12")), SETTINGS)
    with pytest.raises(CameraError, match="cannot be triggered frame by frame"):
        set_up(camera(TriggerSelector=choice("AcquisitionStart")), SETTINGS)
    with pytest.raises(CameraError, match="TriggerMode stays Off, not On"):
        set_up(camera(TriggerMode=Feature("Off", ("On", "Off"), ignores_changes=True)), SETTINGS)
    with pytest.raises(CameraError, match="exposure cannot be set or read"):
        set_up(without("ExposureTime"), SETTINGS)


def test_shortest_period():
    """Readout counts, and is added to the exposure where nothing says that they overlap."""

    def period_s(node_map, exposure_s=2e-3):
        return set_up(node_map, SETTINGS.model_copy(update={"exposure_s": exposure_s})).limits.min_period_s

    assert period_s(camera()) == pytest.approx(1 / 50)
    assert period_s(camera(TriggerOverlap=choice("Off", "ReadOut"))) == pytest.approx(1 / 50 + 2e-3)
    assert period_s(camera(TriggerOverlap=choice("ReadOut", "Off"))) == pytest.approx(1 / 50)
    assert period_s(camera(), exposure_s=0.5) == 0.5  # a camera that forgets its own exposure
    unsaid = without("ResultingFrameRate")
    assert period_s(unsaid) == pytest.approx(2e-3)
    assert any("does not report its frame rate" in sentence for sentence in set_up(unsaid, SETTINGS).unlocked)
    unsaid.features["AcquisitionFrameRate"] = Feature(30.0, bounds=(1.0, 100.0))
    assert period_s(unsaid) == pytest.approx(1 / 100 + 2e-3)


def test_deepest_format():
    def chosen(*formats):
        return set_up(camera(PixelFormat=choice("Mono8", *formats)), SETTINGS).limits.format

    assert chosen("RGB8", "BayerGB8") == FrameFormat("bayer", 8, "gbrg")
    assert chosen("BGR8", "YUV422Packed") == FrameFormat("rgb", 8)
    assert chosen("BayerGR8", "RGB12") == FrameFormat("rgb", 12)
    assert [storable(name) for name in ("BayerBG10", "RGB8Packed", "RGB16Packed")] == [
        FrameFormat("bayer", 10, "bggr"),
        FrameFormat("rgb", 8),
        FrameFormat("rgb", 16),
    ]
    for name in ("Mono12", "BayerRG12p", "BayerRG12Packed", "RGB8_Planar", "RGBa8", "YCbCr422_8", "BayerRG14"):
        assert storable(name) is None


@pytest.mark.parametrize("pixel_format", ["BayerRG8", "BayerBG12", "RGB8", "BGR8", "RGB16"])
@pytest.mark.parametrize("padding", [0, 3])
def test_frames_are_copied_exactly(pixel_format, padding):
    kind = storable(pixel_format)
    limits = CameraLimits((7, 5), kind, (0.0, 1.0), 0.0, True)
    setup = Setup(limits, 1e-3, (), swapped=pixel_format.startswith("BGR"))
    shape = (5, 7, 3) if kind.layout == "rgb" else (5, 7)
    truth = np.random.default_rng(1).integers(0, 2**kind.bits, shape).astype("u2" if kind.bits > 8 else "u1")
    sent = truth[..., ::-1] if setup.swapped else truth
    rows = np.ascontiguousarray(sent).view(np.uint8).reshape(5, -1)
    raw = np.pad(rows, ((0, 0), (0, padding)), constant_values=77).ravel()
    image = copy_image(raw, setup, padding)
    assert image.dtype == truth.dtype
    np.testing.assert_array_equal(image, truth)
    raw[:] = 0
    np.testing.assert_array_equal(image, truth)
    assert image.flags.c_contiguous and image.flags.owndata and image.flags.writeable
    assert copy_image(raw[:-1], setup, padding) is None


def test_frame_numbers_count_on():
    numbers = FrameNumbers()
    assert [numbers.count_on(k) for k in (65533, 65535, 1, 2, 5)] == [65533, 65535, 65536, 65537, 65540]
    assert [numbers.count_on(k) for k in (65535, 2)] == [65535 + 65535, 2 * 65535 + 2]
    long = FrameNumbers()
    assert [long.count_on(k) for k in (0, 1, 70_000, 2**40)] == [0, 1, 70_000, 2**40]


def test_buffers():
    assert buffers_for(10, 1000) == 14
    assert buffers_for(None, 1000) == 256
    assert buffers_for(1000, 1 << 26) == 16
    assert buffers_for(1000, 1 << 40) == 4


def test_which_camera():
    two = [("A1", "Ace"), ("B2", "Dart")]
    assert choose("B2", two) == 1
    assert choose(None, two[:1]) == 0
    with pytest.raises(CameraError, match="no camera has the serial number C3; there is A1 \\(Ace\\), B2 \\(Dart\\)"):
        choose("C3", two)
    with pytest.raises(CameraError, match="2 cameras are there: say which one with serial: A1"):
        choose(None, two)
    with pytest.raises(CameraError, match="no camera is found: look for its power"):
        choose("A1", [])


def test_ready_and_warm(monkeypatch):
    monkeypatch.setattr("hardware.camera.genicam._READY_S", 0.02)
    wait_until_ready(camera(), 2e-3)  # it does not report it
    ready = camera(AcquisitionStatusSelector=choice("AcquisitionActive", "FrameTriggerWait"))
    ready.features["AcquisitionStatus"] = Feature(True)
    wait_until_ready(ready, 2e-3)
    assert ready.get("AcquisitionStatusSelector") == "FrameTriggerWait"
    ready.features["AcquisitionStatus"] = Feature(False)
    with pytest.raises(CameraError, match=r"has taken no triggers for 0\.022 s"):
        wait_until_ready(ready, 2e-3)
    assert sensor_temperature_c(camera(DeviceTemperature=Feature(41.5))) is None  # of what, it does not say
    warm = camera(DeviceTemperature=Feature(41.5), DeviceTemperatureSelector=choice("Mainboard", "Sensor"))
    assert sensor_temperature_c(warm) == 41.5
    assert warm.get("DeviceTemperatureSelector") == "Sensor"
