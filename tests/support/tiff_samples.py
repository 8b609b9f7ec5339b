"""TIFF files as other programs write them."""

import io
import struct

import numpy as np
import tifffile


def tiff(*pages, **options):
    """Return a file of some pages, each an array, or an array and options of its own."""
    file = io.BytesIO()
    own = {key: options.pop(key) for key in ("bigtiff", "byteorder") if key in options}
    with tifffile.TiffWriter(file, **own) as writer:
        for page in pages:
            levels, more = page if isinstance(page, tuple) else (page, {})
            more = {"photometric": "rgb", **options, **more}
            writer.write(np.ascontiguousarray(levels), contiguous=False, metadata=None, **more)
    return file.getvalue()


def packed_tiff(levels, bits):
    """Return a file of (H, W, 3) levels without gaps between them, as libtiff reads them: the highest bit first."""
    height, width = levels.shape[:2]
    digits = (levels.reshape(height, -1, 1) >> np.arange(bits - 1, -1, -1)) & 1
    rows = np.packbits(digits.reshape(height, -1).astype(np.uint8), axis=1)
    usual = {256: width, 257: height, 259: 1, 262: 2, 273: 200, 277: 3, 278: height, 279: rows.size}
    entries = sorted([*((tag, 4, 1, value) for tag, value in usual.items()), (258, 3, 3, 190)])
    head = b"II*\0" + struct.pack("<IH", 8, len(entries)) + b"".join(struct.pack("<HHII", *each) for each in entries)
    return head.ljust(190, b"\0") + struct.pack("<HHH", bits, bits, bits).ljust(10, b"\0") + rows.tobytes()
