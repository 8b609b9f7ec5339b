"""Render what a camera would see of a simulated scene, with its exact truth."""

from typing import TYPE_CHECKING

from tikernels.lazy_names import lazily

if TYPE_CHECKING:
    from tikernels.scene.scene_rendering import SceneTruth, render_scene
    from tikernels.scene.scene_shapes import SCENES

__all__ = ["SCENES", "SceneTruth", "render_scene"]
__getattr__, __dir__ = lazily(__name__)
