import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import serial
from serial.rfc2217 import PortManager
from support.emulators.emulated_dg645 import DG645Emulator
from support.emulators.emulated_line import Emulator

from hardware.pulses import Pulse, PulseTrain
from hardware.settings import TriggerSettings
from hardware.trigger import _dialogue, open_trigger

pytestmark = pytest.mark.timeout(30)


TRAIN = PulseTrain(0.005, 3, Pulse(0.0, 0.0001), Pulse(0.001, 0.00025))


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let silence be found soon."""
    monkeypatch.setattr(_dialogue, "NAME_S", 0.1)
    monkeypatch.setattr(_dialogue, "QUIET_S", 0.03)


class WithoutModemLines(serial.Serial):
    """A port whose control lines go nowhere, as a pseudo-terminal has none."""

    cts = dsr = ri = cd = False

    def _update_dtr_state(self) -> None:
        pass

    def _update_rts_state(self) -> None:
        pass


@contextmanager
def shared_by_rfc2217(device: Emulator) -> Iterator[str]:
    """Serve an emulator's port to one client, as a terminal server would; yield its URL."""
    port = WithoutModemLines(device.url, timeout=0.002)
    server = socket.create_server(("127.0.0.1", 0))
    over = threading.Event()

    def serve() -> None:
        connection, _ = server.accept()
        connection.settimeout(0.002)

        class Connection:
            @staticmethod
            def write(text: bytes) -> None:
                connection.sendall(text)

        manager = PortManager(port, Connection)
        with connection:
            while not over.is_set():
                try:
                    if waiting := port.read(port.in_waiting or 1):
                        connection.sendall(b"".join(manager.escape(waiting)))
                    if not (sent := connection.recv(1024)):
                        return
                    port.write(b"".join(manager.filter(sent)))
                except TimeoutError:
                    continue

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield f"rfc2217://127.0.0.1:{server.getsockname()[1]}"
    finally:
        over.set()
        thread.join()
        server.close()
        port.close()


@pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning")  # pyserial's own
def test_an_instrument_at_a_terminal_server():
    with DG645Emulator() as device, shared_by_rfc2217(device) as url:
        trigger = open_trigger(TriggerSettings(driver="dg645", port=url, baud=9600))
        assert trigger.configure(TRAIN) == TRAIN
        trigger.arm()
        trigger.fire()
        while trigger.status().running:
            pass
        assert device.bursts[0].pulses("CD", device.now) == 3
        trigger.close()
