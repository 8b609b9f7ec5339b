"""Pictures as people bring them: each is measured rightly, or one line names what is the matter with it.

All are made of one frame of a simulated bust, 640x480 px and 12 px a cycle, under the coded pattern. The rig's geometry
is calibrated, its light is not, as after the first afternoon with a board. Right means: at least four fifths of the
picture's surface have an absolute depth, half of these are within 1 mm and 99 of 100 within 3 mm of the true one.
"""

import io
import json
import re
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
import zarr
from PIL import Image, ImageCms  # of matplotlib's own dependencies
from support.missing import import_but_fail_in_ci

from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig

BLUR_PX = (0.6, 0.6, 0.6)
#: From linear sRGB to linear Display P3 and Adobe RGB (1998); rows are the target's red, green and blue.
TO_P3 = np.array([[0.8225, 0.1774, 0.0], [0.0332, 0.9669, 0.0], [0.0171, 0.0724, 0.9108]])
TO_ADOBE = np.array([[0.7151, 0.2849, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0412, 0.9588]])
ADOBE_GAMMA = 563 / 256
TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_90,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_270,
}


def light(code="contrast", period_px=768 / 44, stripes="horizontal", **options):
    """Return the linear light, 0..1, of a simulated frame."""
    rig = simulated_rig(code=code, period_px=period_px, stripes=stripes)
    settings = SimulationSettings(bits=16, pixel_rays=3, projector_blur_px=BLUR_PX, **options)
    return simulate_frame(rig, settings).image / 65535.0


def eight(values):
    return np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)


def sixteen(values):
    return np.rint(65535 * np.clip(values, 0, 1)).astype(np.uint16)


def srgb(linear):
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def into(matrix, linear):
    return np.einsum("ij,hwj->hwi", matrix, linear)


def by_pillow(image, kind, **options):
    file = io.BytesIO()
    picture = Image.fromarray(image) if isinstance(image, np.ndarray) else image
    picture.save(file, kind, **options)
    return file.getvalue()


def jpeg(image, **options):
    return by_pillow(image, "JPEG", **{"quality": 92, **options})


def by_opencv(image, suffix):
    return cv2.imencode(suffix, np.ascontiguousarray(image[..., ::-1]))[1].tobytes()


def held(shown, orientation):
    """Return a JPEG that Exif says how to turn, so that it shows this."""
    tags = Image.Exif()
    tags[274] = orientation
    picture = Image.fromarray(shown)
    return jpeg(picture.transpose(TURNS[orientation]) if orientation > 1 else picture, exif=tags)


def gamma_profile(gamma):
    """Return an ICC profile that says nothing but a gamma."""
    curve = b"curv\0\0\0\0\0\0\0\1" + round(256 * gamma).to_bytes(2, "big") + b"\0\0"
    head = bytes(128) + (1).to_bytes(4, "big") + b"rTRC" + (144).to_bytes(4, "big")
    return head + len(curve).to_bytes(4, "big") + curve


def srgb_profile():
    return ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def heic(image):
    import pillow_heif

    file = io.BytesIO()
    pillow_heif.from_pillow(Image.fromarray(image)).save(file, quality=95, chroma=420)
    return file.getvalue()


@dataclass(frozen=True)
class Frame:
    """The frame that all pictures are made of, and its truth."""

    linear: np.ndarray  # (H, W, 3) light, 0..1
    depth_mm: np.ndarray  # (H, W)

    @property
    def phone(self):
        """(H, W, 3) uint8, as a phone encodes it."""
        return eight(srgb(self.linear))


@pytest.fixture(scope="module")
def frame(cpu):
    rig = simulated_rig(code="contrast")
    truth = simulate_frame(rig, SimulationSettings(bits=16, pixel_rays=3, projector_blur_px=BLUR_PX))
    return Frame(truth.image / 65535.0, truth.points[..., 2])


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    path = tmp_path_factory.mktemp("rig") / "calibration.json"
    simulated_rig(code="contrast").write(path)
    return path


def with_alpha(image):
    return np.dstack([image, np.tile(np.arange(image.shape[1]) % 256, (image.shape[0], 1)).astype(np.uint8)])


MEASURED = {
    **{f"turned by Exif {n}.jpg": lambda f, n=n: held(f.phone, n) for n in range(1, 9)},
    "linear.png": lambda f: by_pillow(eight(f.linear), "PNG"),
    "sixteen bits.png": lambda f: by_opencv(sixteen(f.linear), ".png"),
    "sixteen bits.tif": lambda f: by_opencv(sixteen(f.linear), ".tif"),
    "float.tif": lambda f: by_opencv(f.linear.astype(np.float32), ".tif"),
    "plain.bmp": lambda f: by_pillow(eight(f.linear), "BMP"),
    "plain.ppm": lambda f: by_pillow(eight(f.linear), "PPM"),
    "transparent.png": lambda f: by_pillow(with_alpha(eight(f.linear)), "PNG"),
    "sRGB.png": lambda f: by_pillow(f.phone, "PNG", icc_profile=srgb_profile()),
    "sRGB.jpg": lambda f: jpeg(f.phone),
    "full colour.jpg": lambda f: jpeg(f.phone, quality=95, subsampling=0),
    "progressive.jpg": lambda f: jpeg(f.phone, progressive=True),
    "Display P3.jpg": lambda f: jpeg(eight(srgb(into(TO_P3, f.linear))), icc_profile=srgb_profile(), quality=95),
    "Adobe RGB.tif": lambda f: by_pillow(
        eight(np.clip(into(TO_ADOBE, f.linear), 0, 1) ** (1 / ADOBE_GAMMA)),
        "TIFF",
        icc_profile=gamma_profile(ADOBE_GAMMA),
    ),
    "lossless.webp": lambda f: by_pillow(f.phone, "WEBP", lossless=True),
    "phone.heic": lambda f: heic(f.phone),
    "UPPER CASE.JPG": lambda f: jpeg(f.phone),
    "ünïcode 名前.png": lambda f: by_pillow(eight(f.linear), "PNG"),
}

NAMED = {
    "printed.jpg": (lambda f: jpeg(Image.fromarray(f.phone).convert("CMYK")), "it is in CMYK"),
    "printed.tif": (lambda f: by_pillow(Image.fromarray(f.phone).convert("CMYK"), "TIFF"), "it is in CMYK"),
    "palette.png": (lambda f: by_pillow(Image.fromarray(f.phone).quantize(256), "PNG"), "stored with a palette"),
    "palette.bmp": (lambda f: by_pillow(Image.fromarray(f.phone).quantize(256), "BMP"), "stored with a palette"),
    "palette.tif": (lambda f: by_pillow(Image.fromarray(f.phone).quantize(64), "TIFF"), "stored with a palette"),
    "one bit.png": (lambda f: by_pillow(Image.fromarray(f.phone).convert("1"), "PNG"), "it is grey"),
    "grey.png": (lambda f: by_pillow(Image.fromarray(f.phone).convert("L"), "PNG"), "it is grey"),
    "grey.jpg": (lambda f: jpeg(Image.fromarray(f.phone).convert("L")), "it is grey"),
    "three times the same.png": (
        lambda f: by_pillow(np.repeat(eight(f.linear).mean(axis=2, keepdims=True), 3, axis=2).astype(np.uint8), "PNG"),
        "no fringe stands out",
    ),
    "levels.tif": (lambda f: by_opencv((255 * f.linear).astype(np.float32), ".tif"), "values outside 0..1"),
    "animated.gif": (
        lambda f: by_pillow(
            Image.fromarray(f.phone), "GIF", save_all=True, append_images=[Image.new("RGB", (640, 480))]
        ),
        "a picture in GIF",
    ),
    "animated.webp": (
        lambda f: by_pillow(
            Image.fromarray(f.phone), "WEBP", save_all=True, append_images=[Image.new("RGB", (640, 480), "red")]
        ),
        "it is an animation",
    ),
    "raw.DNG": (lambda f: by_opencv(sixteen(f.linear), ".tif"), "it is a camera's raw file"),
    "cut off.jpg": (lambda f: jpeg(f.phone)[:20000], "truncated: copy it again"),
    "cut off.png": (lambda f: by_pillow(f.phone, "PNG")[:100000], "truncated: copy it again"),
    "empty.png": (lambda f: b"", "is not a picture that can be read"),
    "text.png": (lambda f: b"this is no picture\n" * 50, "is not a picture that can be read"),
    "huge.png": (
        lambda f: by_pillow(Image.new("RGB", (1, 1)), "PNG").replace(
            (1).to_bytes(4, "big") * 2, (100000).to_bytes(4, "big") * 2
        ),
        "COLORPHASE_MAX_PIXELS",
    ),
    "tiny.png": (lambda f: by_pillow(eight(f.linear)[200:208, 300:310], "PNG"), "at least 16x16 px are needed"),
    "cropped.png": (lambda f: by_pillow(eight(f.linear)[100:300, 200:500], "PNG"), "the calibration is for 640x480"),
    "upside down.png": (lambda f: by_pillow(np.ascontiguousarray(eight(f.linear)[::-1, ::-1]), "PNG"), "upside down"),
    "mirrored over.png": (lambda f: by_pillow(np.ascontiguousarray(eight(f.linear)[::-1]), "PNG"), "or mirrored"),
    "blue first.png": (lambda f: by_pillow(np.ascontiguousarray(eight(f.linear)[..., ::-1]), "PNG"), "order B, G, R"),
    "stripes the other way.png": (
        lambda f: by_pillow(eight(light(stripes="vertical")), "PNG"),
        "no horizontal fringe stands out, but a vertical one does: set stripes to 'vertical' (--stripes vertical)",
    ),
    "black.png": (lambda f: by_pillow(Image.new("RGB", (640, 480)), "PNG"), "no fringe stands out"),
    "white.png": (lambda f: by_pillow(Image.new("RGB", (640, 480), "white"), "PNG"), "no fringe stands out"),
    "over-exposed.png": (lambda f: by_pillow(eight(8 * f.linear), "PNG"), "of it is over-exposed: expose it shorter"),
    "dark.png": (lambda f: by_pillow(eight(light(exposure=0.05)), "PNG"), "of full scale only: expose it longer"),
    "fine.png": (lambda f: by_pillow(eight(light(code=None, period_px=4.4)), "PNG"), "px a cycle in this frame, and 4"),
    "coarse.png": (
        lambda f: by_pillow(eight(light(code=None, period_px=5 * 768 / 44)), "PNG"),
        "another period than the calibration's 17.45 px, or the camera another field of view",
    ),
}

#: Measured, with a word of what is lost.
WARNED = {
    "plain pattern.png": (
        lambda f: by_pillow(eight(light(code=None)), "PNG"),
        "the frame does not show the contrast code: project what colorphase pattern makes",
    ),
    "daylight.png": (lambda f: by_pillow(eight(light(ambient=1.0)), "PNG"), "whether other light, blur"),
    "squeezed.jpg": (lambda f: jpeg(f.phone, quality=60), "of the pixels show too little of the code"),
}


def one_line(text):
    return re.sub(r"\s+", " ", text)


def decode(command, tmp_path, calibration, name, content):
    (tmp_path / name).write_bytes(content)
    return command("decode", name, "--out", "result", "--calibration", calibration, "--arch", "cpu", cwd=tmp_path)


@pytest.mark.parametrize("name", MEASURED)
def test_measured_rightly(command, tmp_path, frame, calibration, name):
    if name.endswith(".heic"):
        import_but_fail_in_ci("pillow_heif")
    done = decode(command, tmp_path, calibration, name, MEASURED[name](frame))
    assert done.returncode == 0, done.stderr
    assert "warning" not in done.stderr
    result = zarr.open_group(tmp_path / "result" / "result.zarr", mode="r")
    absolute = result["absolute"][0]
    assert absolute.mean() > 0.8
    error_mm = np.abs(result["points"][0][..., 2] - frame.depth_mm)[absolute]
    error_mm = error_mm[np.isfinite(error_mm)]
    assert np.quantile(error_mm, 0.5) < 1.0
    assert np.quantile(error_mm, 0.99) < 3.0
    report = json.loads((tmp_path / "result" / "report.json").read_text())
    encoded = "linear" if re.search(r"linear|sixteen|float|plain|transparent|名前", name) else "srgb"
    assert report["settings"]["transfer"] == encoded
    assert report["transfer_because"]


@pytest.mark.parametrize("name", NAMED)
def test_the_cause_is_named_and_nothing_is_left_behind(command, tmp_path, frame, calibration, name):
    make, cause = NAMED[name]
    done = decode(command, tmp_path, calibration, name, make(frame))
    assert done.returncode == 1
    assert cause in one_line(done.stderr)
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1 and "Traceback" not in done.stderr
    assert errors[0].count(name) <= 1
    assert not (tmp_path / "result").exists()


@pytest.mark.parametrize("name", WARNED)
def test_what_is_lost_is_said(command, tmp_path, frame, calibration, name):
    make, doubt = WARNED[name]
    done = decode(command, tmp_path, calibration, name, make(frame))
    assert done.returncode == 0, done.stderr
    assert doubt in one_line(done.stderr)
    group = zarr.open_group(tmp_path / "result" / "result.zarr", mode="r")
    assert group["absolute"][0].mean() < 0.95 * group["mask"][0].mean()


def test_a_mirrored_picture_is_a_mirrored_surface(command, tmp_path, frame, calibration):
    """Nothing in it tells: what is left and what is right on an object nobody knows."""
    image = np.ascontiguousarray(eight(frame.linear)[:, ::-1])
    done = decode(command, tmp_path, calibration, "mirrored.png", by_pillow(image, "PNG"))
    assert done.returncode == 0, done.stderr
    result = zarr.open_group(tmp_path / "result" / "result.zarr", mode="r")
    error_mm = (result["points"][0][..., 2] - frame.depth_mm[:, ::-1])[result["absolute"][0]]
    assert np.nanquantile(np.abs(error_mm), 0.9) < 1.0


def test_there_are_forty_odd():
    assert len(MEASURED) + len(NAMED) + len(WARNED) + 1 >= 50
