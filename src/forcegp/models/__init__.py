"""Models of forward dynamics: specification, fitting, prediction, and saved files."""

from forcegp.models.load import register

register()
