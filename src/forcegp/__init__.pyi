__all__: list[str]
__version__: str

from . import compiled as compiled
from . import constraints as constraints
from . import data as data
from . import derivatives as derivatives
from . import dynamics as dynamics
from . import evaluation as evaluation
from . import identification as identification
from . import kinematics as kinematics
from . import models as models
from . import priors as priors
from . import robot as robot
from . import rollout as rollout
from .checks import check as check
from .constraints import ConstrainedSystem as ConstrainedSystem
from .constraints import Plane as Plane
from .constraints import SurfaceContact as SurfaceContact
from .data import Dataset as Dataset
from .data import StreamedDataset as StreamedDataset
from .evaluation import evaluate as evaluate
from .forces.external_wrench import WrenchFrame as WrenchFrame
from .forces.noise import Noise as Noise
from .logs import read_log as read_log
from .models.analytical import AnalyticalModel as AnalyticalModel
from .models.load import load_model as load_model
from .models.structured_gp import StructuredGP as StructuredGP
from .robot import RobotModel as RobotModel
from .robot import load_robot as load_robot
from .scene import Scene as Scene
from .scene import load_scene as load_scene
