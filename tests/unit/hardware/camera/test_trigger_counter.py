"""The camera's count of its triggers, on node maps as SFNC's, Basler's older network cameras' and lesser ones."""

from types import SimpleNamespace

import pytest
from support.genicam_node_map import Feature, NodeMap, choice

from hardware.camera.aravis import AravisCamera
from hardware.camera.basler import BaslerCamera
from hardware.camera.trigger_counter import TriggerCounter
from hardware.errors import CameraError


def counting(**others):
    features = {
        "CounterSelector": choice("Counter0", "Counter1"),
        "CounterEventSource": choice("Off", "FrameStart", "Line1"),
        "CounterEventActivation": choice("FallingEdge", "RisingEdge"),
        "CounterTriggerSource": choice("Line2", "Off"),
        "CounterDuration": Feature(10, bounds=(1, 2**32 - 1)),
        "CounterReset": Feature(0),
        "ChunkModeActive": Feature(False),
        "ChunkSelector": choice("Timestamp", "CounterValue"),
        "ChunkEnable": Feature(False),
        "ChunkCounterSelector": choice("Counter1", "Counter0"),
    }
    return NodeMap({**features, **others})


def test_edges_of_the_line_are_counted_and_put_into_every_frame():
    node_map = counting()
    counter = TriggerCounter(node_map, "Line1")
    assert counter.chunk == "ChunkCounterValue"
    assert node_map.script == [
        "CounterSelector=Counter0",
        "CounterEventSource=Line1",
        "CounterEventActivation=RisingEdge",
        "CounterTriggerSource=Off",
        f"CounterDuration={2**32 - 1}",
        "ChunkModeActive=True",
        "ChunkSelector=CounterValue",
        "ChunkEnable=True",
        "ChunkCounterSelector=Counter0",
    ]
    node_map.script.clear()
    counter.start()
    assert node_map.script == ["CounterSelector=Counter0", "CounterReset"]


def test_an_older_network_camera_of_basler():
    node_map = counting(
        CounterEventSource=choice("FrameTrigger", "FrameStart"),
        CounterResetSource=choice("Off", "Software"),
        ChunkSelector=choice("Framecounter", "Triggerinputcounter"),
    )
    assert TriggerCounter(node_map, "Line1").chunk == "ChunkTriggerinputcounter"
    assert "CounterEventSource=FrameTrigger" in node_map.script
    assert "CounterResetSource=Software" in node_map.script


@pytest.mark.parametrize(
    "change",
    [
        {"CounterEventSource": choice("Off", "FrameStart")},  # which counts frames
        {"ChunkSelector": choice("Timestamp")},
        {"ChunkEnable": Feature(False, locked=True)},
        {"ChunkEnable": Feature(False, ignores_changes=True)},
        {"CounterReset": None},
    ],
)
def test_what_cannot_be_counted_is_left_out(change):
    node_map = counting(**change)
    node_map.features = {name: feature for name, feature in node_map.features.items() if feature is not None}
    counter = TriggerCounter(node_map, "Line1")
    assert counter.chunk is None
    assert node_map.get("ChunkModeActive") is False
    node_map.script.clear()
    counter.start()
    assert node_map.script == []


def test_a_camera_that_is_triggered_by_software_is_left_alone():
    node_map = counting()
    assert TriggerCounter(node_map, "software").chunk is None
    assert node_map.script == []


def test_a_frame_of_basler_has_its_count():
    camera = BaslerCamera.__new__(BaslerCamera)
    camera._counter = SimpleNamespace(chunk="ChunkCounterValue")
    camera._genicam = SimpleNamespace(IsReadable=lambda node: node is not None)
    chunks = {"ChunkCounterValue": SimpleNamespace(Value=7)}

    def result(available, found):
        nodes = SimpleNamespace(GetNode=found.get)
        return SimpleNamespace(IsChunkDataAvailable=lambda: available, GetChunkDataNodeMap=lambda: nodes)

    assert camera._triggers_of(result(True, chunks)) == 7
    assert camera._triggers_of(result(True, {})) is None
    assert camera._triggers_of(result(False, chunks)) is None


def test_a_frame_of_aravis_has_its_count():
    def read(chunks, buffer, name):
        assert (chunks, name) == (5, b"ChunkCounterValue")
        if buffer == 2:
            raise CameraError("chunk not found")
        return 7

    camera = AravisCamera.__new__(AravisCamera)
    camera._counter, camera._chunks, camera._device = SimpleNamespace(chunk="ChunkCounterValue"), 5, 0
    camera._aravis = SimpleNamespace(
        arv_buffer_has_chunks=lambda buffer: buffer > 0, arv_chunk_parser_get_integer_value=read
    )
    assert [camera._triggers_of(buffer) for buffer in (0, 1, 2)] == [None, 7, None]
