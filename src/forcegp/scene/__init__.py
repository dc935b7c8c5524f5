"""Scene files."""

from forcegp.scene.load import BUNDLED, Scene, load_scene

__all__ = ["BUNDLED", "Scene", "load_scene"]
