"""Camera models: the map between rays of a camera frame and pixels."""

from sfm.core.cameras.camera import Camera
from sfm.core.cameras.models import COLMAP_MODELS, MODELS, CameraModel, model_by_id, model_by_name

__all__ = ["COLMAP_MODELS", "MODELS", "Camera", "CameraModel", "model_by_id", "model_by_name"]
