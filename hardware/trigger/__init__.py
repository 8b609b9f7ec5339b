"""Where pulses come from: one file an instrument, each with the methods of `hardware.protocols.Trigger`."""

from collections.abc import Callable

from hardware.errors import RigError, TriggerError
from hardware.link import Link
from hardware.protocols import Trigger
from hardware.settings import TriggerSettings
from hardware.trigger._dialogue import names


def open_trigger(settings: TriggerSettings) -> Trigger:
    """Open the instrument that a rig's settings name.

    Raises
    ------
    RigError
        The settings contradict each other, or the driver is none that has a port.
    TriggerError
        It cannot be reached, or something else is there.
    """
    if settings.driver == "simulated":
        raise RigError("trigger.driver: a file's rig is real; without one, use `colorphase capture --rig simulated`")
    if settings.port is None:
        raise RigError("trigger.port: write where the trigger source is; `colorphase devices` lists serial ports")
    outputs = {"projector_output": settings.projector_output, "camera_output": settings.camera_output}
    chosen = {name: letter for name, letter in outputs.items() if letter is not None}
    if chosen and settings.driver != "quantum-composers":
        raise RigError(f"trigger.{next(iter(chosen))}: the outputs of {settings.driver} are fixed; leave it out")
    if settings.driver == "box":
        from hardware.trigger.box import TriggerBox

        def box(link: Link) -> Trigger:
            return TriggerBox(link, strobe=settings.strobe, vsync=settings.vsync is not None)

        return _opened(settings.port, settings.baud, (115200,), b"\n", box)
    if settings.strobe or settings.vsync:
        raise RigError(f"trigger: {settings.driver} counts neither strobe nor vsync; leave them out")
    if settings.driver == "quantum-composers":
        from hardware.trigger import quantum_composers

        def generator(link: Link) -> Trigger:
            return quantum_composers.QuantumComposers(link, **chosen)

        return _opened(settings.port, settings.baud, quantum_composers.BAUDS, quantum_composers.TERMINATOR, generator)
    if settings.driver == "dg645":
        from hardware.trigger import dg645

        return _opened(settings.port, settings.baud, dg645.BAUDS, dg645.TERMINATOR, dg645.DG645)
    raise RigError(f"trigger.driver: {settings.driver} is no instrument with a port")


def _opened(
    port: str, baud: int | None, usual: tuple[int, ...], terminator: bytes, driver: Callable[[Link], Trigger]
) -> Trigger:
    """Open a port at its baud rate, or at the first usual one at which something says its name."""
    bauds = usual if baud is None else (baud,)
    if port.lower().startswith("socket://"):
        bauds = bauds[:1]  # it has none
    for each in bauds:
        link = Link(port, baud=each, terminator=terminator)
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
        f"{port}: nothing answers at {tried} baud: is the instrument on, its cable in, this its remote interface, "
        "and trigger.driver right?"
    )
