"""Common parts of all trigger sources at a port: how they are opened by their settings, and closed."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

from hardware.errors import RigError, TriggerError
from hardware.link import Link
from hardware.protocols import Identity, Strobe
from hardware.pulses import TriggerLimits
from hardware.settings import TriggerSettings
from hardware.trigger._dialogue import names


class PortTrigger(ABC):
    """A trigger source whose driver has found out what it is, and closes its link."""

    _link: Link
    _identity: Identity
    _limits: TriggerLimits

    @property
    def identity(self) -> Identity:
        """Identity found when it was opened."""
        return self._identity

    @property
    def limits(self) -> TriggerLimits:
        """Limits of its pulses."""
        return self._limits

    @abstractmethod
    def abort(self) -> None:
        """Stop, outputs low."""

    def strobes(self) -> tuple[Strobe, ...]:
        """Return nothing, where it sees no exposures."""
        return ()

    def close(self) -> None:
        """Stop and let go of the port."""
        with suppress(TriggerError):
            self.abort()
        self._link.close()


T = TypeVar("T", bound=PortTrigger)


def open_port(settings: TriggerSettings, usual: tuple[int, ...], terminator: bytes, driver: Callable[[Link], T]) -> T:
    """Open a port at its baud rate, or at the first usual one at which something reports its name.

    Parameters
    ----------
    settings : TriggerSettings
        The port, and the baud rate where it is known.
    usual : tuple of int
        Baud rates to try where it is not.
    terminator : bytes
        End of a line that is sent.
    driver : callable
        Called with the open link; returns the trigger source.

    Raises
    ------
    RigError
        No port is given.
    TriggerError
        It cannot be opened, nothing answers, or something else does.
    """
    if settings.port is None:
        raise RigError("trigger.port: write where the trigger source is; `colorphase devices` lists serial ports")
    bauds = usual if settings.baud is None else (settings.baud,)
    if settings.port.lower().startswith("socket://"):
        bauds = bauds[:1]  # it has none
    for baud in bauds:
        link = Link(settings.port, baud=baud, terminator=terminator)
        try:
            # The first question may run into what another baud rate left there.
            if len(bauds) == 1 or any(name for _ in range(2) for name in names(link)):
                return driver(link)
        except BaseException:
            link.close()
            raise
        link.close()
    tried = ", ".join(map(str, bauds))
    raise TriggerError(
        f"{settings.port}: nothing answers at {tried} baud: check the instrument's power, cable and remote "
        "interface, and trigger.driver"
    )


def chosen_outputs(settings: TriggerSettings) -> dict[str, str]:
    """Return the outputs that the settings choose, by the names of their keys."""
    outputs = {"projector_output": settings.projector_output, "camera_output": settings.camera_output}
    return {name: letter for name, letter in outputs.items() if letter is not None}


def refuse_outputs(settings: TriggerSettings) -> None:
    """Refuse a choice of outputs, of an instrument that leaves none."""
    for name in chosen_outputs(settings):
        raise RigError(f"trigger.{name}: the outputs of {settings.driver} are fixed; leave it out")


def refuse_inputs(settings: TriggerSettings) -> None:
    """Refuse wires back from camera and projector, of an instrument that counts neither."""
    if settings.strobe or settings.vsync:
        raise RigError(f"trigger: {settings.driver} counts neither strobe nor vsync; leave them out")
