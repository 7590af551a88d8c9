"""The head that is fed: a measured face with a jaw, drawn, touchable, and placed by recordings."""

from robo_manip_baselines.envs.mujoco.face.build import BODIES, FACES, add_face
from robo_manip_baselines.envs.mujoco.face.model import MAX_OPENING, REST_OPENING, FaceModel

__all__ = ["BODIES", "FACES", "MAX_OPENING", "REST_OPENING", "FaceModel", "add_face"]
