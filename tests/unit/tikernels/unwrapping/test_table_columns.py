"""Parts of tables, read and written."""

import numpy as np
import pytest

from tikernels import runtime
from tikernels.traffic import traffic
from tikernels.unwrapping.table_columns import columns_at, first_columns, put_columns


@pytest.fixture
def table(arch):
    return np.arange(4 * 50, dtype=np.int32).reshape(4, 50)


@pytest.mark.parametrize("count", [0, 1, 17, 50])
def test_first_columns_come_and_go_back(table, count):
    buffer = runtime.to_device(table.copy())
    columns = first_columns(buffer, count)
    np.testing.assert_array_equal(columns, table[:, :count])
    columns[2] += 1000
    put_columns(columns, buffer)
    expected = table.copy()
    expected[2, :count] += 1000
    np.testing.assert_array_equal(runtime.to_host(buffer), expected)


@pytest.mark.parametrize("places", [[], [3], [49, 0, 7, 7]])
def test_columns_anywhere(table, places):
    places = np.array(places, np.int64)
    columns = columns_at(runtime.to_device(table), places)
    np.testing.assert_array_equal(columns, table[:, places])


def test_only_what_is_asked_for_is_read(table, arch):
    buffer = runtime.to_device(table)
    traffic.clear()
    first_columns(buffer, 5)
    columns_at(buffer, np.array([1, 2]))
    assert traffic.read_bytes == (0 if arch == "cpu" else 4 * (5 + 2) * 4)
