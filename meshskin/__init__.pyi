"""The public names and the modules that define them, for type checkers and for `__init__.py`."""

from . import contact as contact
from . import effects as effects
from .contact.indenter import Indenter as Indenter
from .contact.material import Material as Material
from .core.errors import LeftOutWarning as LeftOutWarning
from .core.errors import MeshskinError as MeshskinError
from .estimation.adaptive import adapt as adapt
from .estimation.calibrate import calibrate as calibrate
from .estimation.calibration import Calibration as Calibration
from .estimation.kinematics.calibrate_log import calibrate_log as calibrate_log
from .estimation.kinematics.log_calibration import LogCalibration as LogCalibration
from .estimation.layout.layout import Layout as Layout
from .estimation.layout.layout import layout as layout
from .estimation.online.frames import ContactFrames as ContactFrames
from .estimation.online.online_calibration import OnlineCalibration as OnlineCalibration
from .estimation.posegraph import PoseGraph as PoseGraph
from .estimation.recalibrate.recalibrate import recalibrate as recalibrate
from .estimation.recalibrate.result import Recalibration as Recalibration
from .estimation.recalibrate.touch_design import next_touches as next_touches
from .estimation.self_touch.calibrate import SelfTouch as SelfTouch
from .estimation.self_touch.calibrate import self_touch as self_touch
from .estimation.self_touch.side import TouchSide as TouchSide
from .exploration.plan import explore as explore
from .exploration.reach import reach as reach
from .geometry.body import Body as Body
from .geometry.region import Cap as Cap
from .geometry.region import Disc as Disc
from .geometry.region import Faces as Faces
from .geometry.region import HalfSpace as HalfSpace
from .geometry.region import Patch as Patch
from .geometry.region import Whole as Whole
from .recording.log_map import LogMap as LogMap
from .recording.readers import read_log as read_log
from .recording.recording import Recording as Recording
from .recording.recording_files import RecordingWriter as RecordingWriter
from .recording.resample import log_frames as log_frames
from .robot.arm import Arm as Arm
from .robot.robot import Robot as Robot
from .scene.belief import Belief as Belief
from .scene.scene import Scene as Scene
from .scene.settings import Exploration as Exploration
from .scene.settings import Law as Law
from .scene.settings import Loop as Loop
from .scene.settings import Readout as Readout
from .simulation.simulate import simulate as simulate
from .simulation.static_contacts import press as press
from .skin.compare import compare as compare
from .skin.lint import lint as lint
from .skin.skin import Skin as Skin
from .study.sensitivity.budget import budget as budget
from .study.sensitivity.cost import cost as cost
from .study.sweep.study import Study as Study
from .tuning.tune import tune as tune

__version__: str
__all__: list[str]
