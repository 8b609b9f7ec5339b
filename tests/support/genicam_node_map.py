"""A GenICam camera's features without a camera: with a memory of what was done to them, and as unruly as is wanted."""

from dataclasses import dataclass, field

from hardware.camera.genicam import Value
from hardware.errors import CameraError


@dataclass
class Feature:
    """One of a camera's features, and how it misbehaves."""

    value: Value
    options: tuple[str, ...] = ()
    bounds: tuple[float, float] = (0.0, 1e9)
    step: int = 1
    locked: bool = False  # refuses to be changed
    ignores_changes: bool = False  # accepts a change without an error, and stays as it was


@dataclass
class NodeMap:
    """Features with a memory of what was done to them."""

    features: dict[str, Feature]
    script: list[str] = field(default_factory=list)

    def has(self, name):
        """Whether it is there."""
        return name in self.features

    def get(self, name):
        """Return its value."""
        return self.features[name].value

    def set(self, name, value):
        """Change it, and remember."""
        feature = self.features[name]
        if feature.locked or (feature.options and value not in feature.options):
            raise CameraError(f"{name} refuses {value}")
        self.script.append(f"{name}={value}")
        if not feature.ignores_changes:
            feature.value = value

    def execute(self, name):
        """Remember a command."""
        self.script.append(name)

    def options(self, name):
        """Return its entries."""
        return self.features[name].options

    def bounds(self, name):
        """Return its limits."""
        return self.features[name].bounds

    def step(self, name):
        """Return its step."""
        return self.features[name].step


def choice(value, *options):
    return Feature(value, (value, *options))
