"""Models of the forward dynamics: what they are made of, fitting, predicting, and reading them back."""

from forcegp.models.load import register

register()
