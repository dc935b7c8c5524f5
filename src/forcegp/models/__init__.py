"""Models of forward dynamics: specifications, fitting, predictions, and saved files."""

from forcegp.models.load import register

register()
