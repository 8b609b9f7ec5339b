"""Size and time of a decoded frame in the store, by compressor: python tests/benchmarks/compressors.py [WxH].

CPU time of one thread, the best of five; all fields, as they are and rounded as the store rounds them.
"""

import sys
import time

import numpy as np
from numcodecs import Blosc, Zstd, blosc

from pipeline import Decoder, DecodeSettings
from pipeline.decoding.frame import FIELDS
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig

CODECS = {
    "lz4, bits shuffled": Blosc("lz4", 5, Blosc.BITSHUFFLE),
    "lz4, bytes shuffled": Blosc("lz4", 5, Blosc.SHUFFLE),
    "zstd 1, bits shuffled": Blosc("zstd", 1, Blosc.BITSHUFFLE),
    "zstd 1, bytes shuffled": Blosc("zstd", 1, Blosc.SHUFFLE),
    "zstd 3, bits shuffled": Blosc("zstd", 3, Blosc.BITSHUFFLE),
    "zstd, zarr's default": Zstd(0),
}


def cpu_ms(call, *arguments):
    best = np.inf
    for _ in range(5):
        begin = time.process_time()
        result = call(*arguments)
        best = min(best, time.process_time() - begin)
    return 1e3 * best, result


def main() -> None:
    """Decode a frame, compress its fields, print a table."""
    width, height = map(int, (sys.argv[1] if len(sys.argv) > 1 else "640x480").split("x"))
    blosc.use_threads = False
    simulation = SimulationSettings()
    rig = simulated_rig((width, height)).model_copy(update={"crosstalk_matrix": simulation.crosstalk_matrix})
    frame = Decoder(DecodeSettings(), rig, arch="cpu").decode(simulate_frame(rig, simulation).image)
    plain = {name: np.ascontiguousarray(getattr(frame, name)) for name in FIELDS}
    kept = {name: FIELDS[name].rounded(values, frame.noise_levels, in_mm=True) for name, values in plain.items()}
    rounded = {name: np.ascontiguousarray(values) for name, values in kept.items()}
    print(f"{width}x{height}, {sum(values.nbytes for values in plain.values()) / 1e6:.1f} MB")
    print(f"{'':24}{'plain MB':>10}{'ms':>6}{'back':>6}{'rounded MB':>12}{'ms':>6}{'back':>6}")
    for codec_name, codec in CODECS.items():
        row = []
        for fields in (plain, rounded):
            parts = []
            for values in fields.values():
                there, chunk = cpu_ms(codec.encode, values)
                parts.append((len(chunk) / 1e6, there, cpu_ms(codec.decode, chunk)[0]))
            row += np.sum(parts, axis=0).tolist()
        print(f"{codec_name:24}{row[0]:10.2f}{row[1]:6.1f}{row[2]:6.1f}{row[3]:12.2f}{row[4]:6.1f}{row[5]:6.1f}")
    print("one field, rounded, with the first:")
    for name, values in rounded.items():
        codec = next(iter(CODECS.values()))
        sizes = [len(codec.encode(v)) / 1e6 for v in (plain[name], values)]
        print(f"  {name:24}{sizes[0]:6.2f} -> {sizes[1]:.2f} MB")


if __name__ == "__main__":
    main()
