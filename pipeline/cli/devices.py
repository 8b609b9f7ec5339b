"""`colorphase devices`."""

from rich.table import Table

from hardware.camera import list_cameras
from hardware.display import list_displays
from hardware.drivers import DRIVERS
from hardware.link import list_serial_ports
from hardware.plugins import announced
from pipeline.cli.console import stdout
from pipeline.output.formats.table import GROUP
from tikernels import runtime


def devices() -> None:
    """List where kernels can run, cameras, drivers of other packages, serial ports, and displays for pictures.

    Example: colorphase devices
    """
    table = Table("what", "name", "note")
    for arch in runtime.supported_archs():
        software = arch == "vulkan" and all(device.software for device in runtime.vulkan_devices())
        names = ", ".join(device.name for device in runtime.vulkan_devices()) if arch == "vulkan" else ""
        table.add_row("arch", arch, f"{names} (software: for checking, slow)" if software else names)
    table.add_row("kernel language", runtime.kernel_language(), "")
    for camera in list_cameras():
        note = f"driver {camera.driver}" + (f": {camera.note}" if camera.note else "")
        table.add_row("camera", str(camera.identity or ""), note)
    for group in (*DRIVERS, GROUP):
        for name, plugins in announced(group).items():
            table.add_row(group, name, " and ".join(map(str, plugins)))
    for port in list_serial_ports():
        table.add_row("serial port", port.device, port.description)
    for display in list_displays():
        table.add_row("display", str(display.number), "{}x{}".format(*display.size_px))
    stdout.print(table)
