"""Loading of scene files and model tables."""

from forcegp.scene.load import BUNDLED, ModelTable, Scene, default_model_table, load_model_table, load_scene

__all__ = ["BUNDLED", "ModelTable", "Scene", "default_model_table", "load_model_table", "load_scene"]
