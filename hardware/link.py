"""The serial line to what triggers projector and camera."""

from dataclasses import dataclass

from serial.tools import list_ports


@dataclass(frozen=True)
class SerialPort:
    """A serial port of this machine."""

    device: str
    description: str


def list_serial_ports() -> list[SerialPort]:
    """Return the serial ports that something is connected to, by name."""
    return [SerialPort(port.device, port.description) for port in sorted(list_ports.comports())]
