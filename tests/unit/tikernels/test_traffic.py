"""What is counted of calls, copies and reads."""

import numpy as np

from tikernels import runtime
from tikernels.launching import constant
from tikernels.traffic import traffic
from tikernels.transposing import transpose

SHAPE = (16, 24, 3)


def test_calls_copies_and_reads_are_counted(arch):
    image = np.zeros(SHAPE, np.uint8)
    on_gpu = arch != "cpu"
    traffic.clear()
    turned = transpose(image)
    assert traffic.calls == 1
    assert traffic.copied_calls == int(on_gpu)
    assert traffic.sent_bytes >= image.nbytes * on_gpu
    sent = traffic.sent_bytes
    runtime.to_host(turned)
    assert traffic.reads == int(on_gpu)
    assert traffic.read_bytes == image.nbytes * on_gpu
    buffer = runtime.to_device(image)
    assert traffic.sent_bytes == sent + image.nbytes * on_gpu
    traffic.clear()
    transpose(buffer)
    assert (traffic.calls, traffic.copied_calls, traffic.sent_bytes) == (1, 0, 0)


def test_what_is_constant_is_sent_once(arch):
    image = constant(np.arange(np.prod(SHAPE), dtype=np.uint8).reshape(SHAPE))
    traffic.clear()
    first, second = (np.array(runtime.to_host(transpose(image))) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(first, image.swapaxes(0, 1))
    assert traffic.copied_calls == 0
    assert traffic.sent_bytes == image.nbytes * (arch != "cpu")
    assert not image.flags.writeable
