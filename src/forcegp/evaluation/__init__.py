"""How good a model is: errors and uncertainty by joint, trivial predictors beside it, and a verdict."""

from forcegp.evaluation.evaluation import Evaluation, evaluate

__all__ = ["Evaluation", "evaluate"]
