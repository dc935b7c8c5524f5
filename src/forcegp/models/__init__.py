"""Models of forward dynamics: specifications, fitting, predictions, and saved files."""

from forcegp.gp.optimise import LearningOptions as LearningOptions
from forcegp.models.independent_gp import IndependentGP as IndependentGP
from forcegp.models.load import register
from forcegp.models.neural import NeuralNetwork as NeuralNetwork
from forcegp.options import Inference as Inference

register()
