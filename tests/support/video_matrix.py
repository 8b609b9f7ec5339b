"""Videos of every container, codec, layout, range, matrix and turn, all of one picture: what each holds."""

from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import av
import numpy as np
import reference

from tikernels.raw.pixel_format import PixelFormat

MATRIX_TAGS = {"bt709": 1, "bt601": 6, "bt2020": 9}
SUBSAMPLING = {"420": (2, 2), "422": (2, 1), "440": (1, 2), "444": (1, 1), "411": (4, 1), "410": (4, 4)}
LOSSLESS_H264 = {"qp": "0"}
GREY, PALETTE, OTHER = "it is grey, but the phase is in the colours", "with a palette", "is not supported: convert it"


@dataclass(frozen=True)
class Film:
    """A file, and how its frame is stored in it."""

    container: str
    codec: str
    pixels: str
    options: dict[str, str] = field(default_factory=dict)
    matrix: str = "bt601"
    full_range: bool = False
    tagged: bool = False  # whether matrix and range are in the file; else they are what is assumed
    turn: int = 0  # counterclockwise, degrees, as its head says
    bottom_up: bool = False
    lossy: bool = False
    bayer: str | None = None
    refused: str | None = None

    def __str__(self) -> str:
        tags = f" {self.matrix} {'full' if self.full_range else 'limited'}" if self.tagged else ""
        turn = f" turned by {self.turn}" if self.turn else ""
        return f"{self.container} {self.codec} {self.pixels}{tags}{turn}{' bottom up' if self.bottom_up else ''}"


def films() -> list[Film]:
    """Return all files."""
    made = []

    def add(containers: str, codec: str, layouts: str, **more: Any) -> None:
        made.extend(Film(c, codec, p, **more) for c, p in product(containers.split(), layouts.split()))

    add("mkv avi", "ffv1", "yuv420p yuv422p yuv444p yuv440p yuv411p yuv410p bgr0 gbrp10le gbrp16le yuva420p")
    add("mkv", "ffv1", "yuv420p10le yuv422p12le yuv444p16le yuva444p10le yuv422p10le gbrp12le bgra gbrap16le rgb48le")
    add("mkv", "ffv1", "gray gray12le", bayer="rggb")
    add("mkv", "ffv1", "gray gray10le", refused=GREY)
    add("avi", "rawvideo", "yuv420p yuyv422 uyvy422 bgr24 bgra nv12")
    add("avi", "rawvideo", "bgr24 bgra", bottom_up=True)
    add("avi mkv", "rawvideo", "y210le")
    add("mov", "rawvideo", "yuyv422 uyvy422 rgb24 bgra argb rgb48be")
    add("nut", "rawvideo", "nv12 nv21 yuv410p yuv411p yuv440p yvyu422 yuv420p16be gbrp rgba abgr")
    add("nut", "rawvideo", "yuva422p rgb48le bgr48be rgba64le yuv444p10le yuv420p9le yuv422p14le gbrap")
    add("nut", "rawvideo", "bayer_rggb8 bayer_gbrg8 bayer_bggr16le")
    add("nut", "rawvideo", "gray ya8", refused=GREY)
    add("nut", "rawvideo", "pal8", refused=PALETTE)
    add("nut", "rawvideo", "rgb565le bgr555le v30xle", refused=OTHER)
    add("avi", "huffyuv", "yuv422p rgb24 bgra")
    add("avi", "ffvhuff", "yuv420p yuv444p")
    add("mp4 mov mkv ts", "libx264", "yuv420p yuv422p yuv444p", options=LOSSLESS_H264)
    add("mp4 ts", "libx264", "yuv420p10le", options=LOSSLESS_H264)
    add("mkv", "libx264rgb", "rgb24 bgr0", options=LOSSLESS_H264)
    add(
        "avi mov mkv",
        "mjpeg",
        "yuvj420p yuvj422p yuvj444p",
        options={"qmin": "2", "qmax": "2"},
        full_range=True,
        lossy=True,
    )
    add("mov", "prores_ks", "yuv422p10le yuv444p10le", lossy=True)
    add("mov", "dnxhd", "yuv422p", options={"profile": "dnxhr_hq"}, matrix="bt709", tagged=True, lossy=True)
    add("mkv mp4", "libvpx-vp9", "yuv420p yuv444p", options={"lossless": "1"})
    for matrix, full_range in product(MATRIX_TAGS, (False, True)):
        tags = {"matrix": matrix, "full_range": full_range, "tagged": True}
        add("mp4", "libx264", "yuv420p", options=LOSSLESS_H264, **tags)
        add("mkv", "ffv1", "yuv422p10le", **tags)
    for turn in (90, 180, 270):
        add("mov mp4 mkv", "libx264", "yuv420p", options=LOSSLESS_H264, turn=turn)
        add("mkv", "ffv1", "yuv422p bgr0", turn=turn)
        add("mov", "mjpeg", "yuvj422p", options={"qmin": "2", "qmax": "2"}, full_range=True, lossy=True, turn=turn)
    return made


def layout_of(film: Film) -> PixelFormat | None:
    """Return the planes that hold the frame of a YUV film; None: it is RGB, or a mosaic."""
    plain = {"nv12": "yuv420p", "nv21": "yuv420p", "y210le": "yuv422p10le"}
    plain |= dict.fromkeys(("yuyv422", "uyvy422", "yvyu422"), "yuv422p")
    name = plain.get(film.pixels, film.pixels).replace("yuva", "yuv").replace("yuvj", "yuv")
    if not name.startswith("yuv"):
        return None
    bits = int(name[7:].removesuffix("le").removesuffix("be") or 8)
    siting = "centre" if film.codec == "mjpeg" else "left"
    return PixelFormat(
        "yuv", bits, subsampling=SUBSAMPLING[name[3:6]], siting=siting, matrix=film.matrix, full_range=film.full_range
    )


def planar_frame(film: Film, picture: np.ndarray) -> tuple[av.VideoFrame, np.ndarray]:
    """Return a frame for a film's encoder, of a picture in 0..1, and what is in it as RGB in 0..1."""
    layout = layout_of(film)
    height, width = picture.shape[:2]
    if layout is not None:
        planes = reference.subsample_chroma(picture, layout)
        subsampling = next(name for name, step in SUBSAMPLING.items() if step == layout.subsampling)
        name = f"yuv{subsampling}p{'' if layout.bits == 8 else f'{layout.bits}le'}"
        twin = reference.convert_chroma(planes, layout)
    elif film.bayer is not None or film.pixels.startswith("bayer"):
        pattern = film.bayer or film.pixels[6:10]
        bits = int(film.pixels.removeprefix("gray").removesuffix("le") or 8) if film.bayer else 8
        bits = 16 if film.pixels.endswith("16le") and not film.bayer else bits
        mosaic = np.rint((2**bits - 1) * reference.mosaic(picture, pattern)).astype(
            np.uint8 if bits == 8 else np.uint16
        )
        planes, name = [mosaic], film.pixels
        twin = reference.demosaic(mosaic, PixelFormat("bayer", bits, bayer=pattern), "horizontal")
    else:
        deep = any(digits in film.pixels for digits in ("48", "64", "10", "12", "16"))
        bits = next((int(d) for d in ("10", "12") if d in film.pixels), 16) if deep else 8
        values = np.rint((2**bits - 1) * picture).astype(np.uint16 if deep else np.uint8)
        planes = [np.ascontiguousarray(values[..., i]) for i in (1, 2, 0)]
        name, twin = f"gbrp{'' if bits == 8 else f'{bits}le'}", values / (2**bits - 1)
    frame = av.VideoFrame(width, height, name)
    for buffer, plane in zip(frame.planes, planes, strict=True):
        np.ndarray(plane.shape, plane.dtype, buffer, 0, (buffer.line_size, plane.itemsize))[...] = plane
    return (frame if name == film.pixels else frame.reformat(format=film.pixels, threads=1)), twin


def write(film: Film, path: Any, picture: np.ndarray) -> np.ndarray:
    """Write a film of one frame, and return what it should show, RGB in 0..1."""
    stored = np.rot90(picture, -(film.turn // 90))
    if film.refused is None:
        frame, twin = planar_frame(film, np.ascontiguousarray(stored[::-1] if film.bottom_up else stored))
    else:
        frame, twin = av.VideoFrame(stored.shape[1], stored.shape[0], film.pixels), None
        for plane in frame.planes:
            plane.update(bytes(plane.buffer_size))
    with av.open(str(path), "w") as container:
        stream = container.add_stream(film.codec, rate=30, options=film.options)
        stream.width, stream.height, stream.pix_fmt = frame.width, frame.height, film.pixels
        if film.turn:
            stream.set_display_rotation(film.turn if film.turn < 180 else film.turn - 360)
        if film.tagged:
            for target in (stream.codec_context, frame):
                target.colorspace, target.color_range = MATRIX_TAGS[film.matrix], 2 if film.full_range else 1
        frame.pts = 0
        container.mux([*stream.encode(frame), *stream.encode()])
    if film.bottom_up:
        data = bytearray(path.read_bytes())
        place = data.index(b"strf") + 16
        data[place : place + 4] = frame.height.to_bytes(4, "little")
        path.write_bytes(data)
        twin = twin[::-1]
    if film.lossy:
        twin = taken_out(path, layout_of(film))
    return None if twin is None else np.ascontiguousarray(np.rot90(twin, film.turn // 90))


def taken_out(path: Any, layout: PixelFormat) -> np.ndarray:
    """Return the frame that PyAV takes out of a file, as the twin develops its planes."""
    with av.open(str(path)) as container:
        frame = next(container.decode(video=0))
        layout = replace(layout, bits=frame.format.components[0].bits)
        planes = [
            np.frombuffer(buffer, layout.dtype).reshape(buffer.height, -1)[:, : buffer.width] for buffer in frame.planes
        ]
    return reference.convert_chroma(planes[:3], layout)
