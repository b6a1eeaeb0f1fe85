"""The lens models that calibration offers, and in which order their parameters are released.

| name | model of the camera | coefficients |
|---|---|---|
| pinhole | PINHOLE | none |
| simple_radial, radial | SIMPLE_RADIAL, RADIAL | k; k1, k2, with one focal length |
| opencv4 | OPENCV | k1, k2, p1, p2 |
| opencv5 | FULL_OPENCV, k4 = k5 = k6 = 0 | and k3: OpenCV's default |
| opencv8 | FULL_OPENCV | and k4, k5, k6: OpenCV's rational model |
| opencv12 | FULL_OPENCV_THIN_PRISM | and s1 … s4: OpenCV's thin prism |
| fisheye | OPENCV_FISHEYE | k1 … k4 of Kannala and Brandt |
| eucm | EUCM | α, β of the enhanced unified model |
| double_sphere | DOUBLE_SPHERE | ξ, α of Usenko, Demmel and Cremers |
| division | EUCM, α = ½ | β = −4 k of the division model, a ray ∝ (a, b, 1 + k (a² + b²)) |

Parameters that are released together at first shape the image most. A rational function with more coefficients than
photos can bear has several minima, where a pole and a zero lie side by side among the corners. Which of them is found
depends on the way: with all coefficients released at once from none, by steps whose damping falls slowly, 2 of 132
trials on real and made-up corners end above OpenCV, which goes that way as well. By stages 5 of 72 do.

Of a double sphere f, ξ and α do the same to the image near ξ = 0: with d the distance of a point, all three move it by
a combination of d and z alone. So it cannot start there, and for each minimum with ξ < 0 there is nearly another with
ξ > 0; where the best ξ is 0, which is the unified camera, it is held there, as photos do not tell it from the focal
length.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np

from sfm.core.arrays import Vector
from sfm.core.cameras import Camera, model_by_name
from sfm.core.cameras.priors import infer_camera


@dataclasses.dataclass(frozen=True, slots=True)
class Lens:
    """One row of the table.

    Attributes:
        model: name of the camera model.
        stages: names of the parameters that each stage releases; what none names stays as it starts.
        start: "perspective" is found by Zhang's closed form, "wide" by trying focal lengths.
        shape: start of parameters that do not start at zero.
        at_once: all is released at once first, and stages are for where that finds no minimum.
        rival: other stages, for where the first do not find one either.
        other_shape: another start of these, beyond which the cost has another minimum.
        spare: parameters that are held, and at what, where the views leave them open.
    """

    name: str
    model: str
    stages: tuple[tuple[str, ...], ...]
    start: Literal["perspective", "wide"] = "perspective"
    shape: tuple[tuple[str, float], ...] = ()
    at_once: bool = False
    rival: tuple[tuple[str, ...], ...] = ()
    other_shape: tuple[tuple[str, float], ...] = ()
    spare: tuple[tuple[str, float], ...] = ()

    @property
    def free_names(self) -> tuple[str, ...]:
        """Everything that is estimated, in the model's order."""
        free = {name for stage in self.stages for name in stage}
        return tuple(name for name in model_by_name(self.model).param_names if name in free)

    def columns(self, stages: int | None = None) -> np.ndarray:
        """Positions of the parameters that the first so many stages release; all of them by default."""
        free = {name for stage in self.stages[:stages] for name in stage}
        return np.flatnonzero([name in free for name in model_by_name(self.model).param_names])

    def camera(self, width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> Camera:
        """The camera with these focal lengths on its axis and principal point, px, and no distortion."""
        camera = infer_camera(self.model, width, height)
        shape = dict(self.shape)
        fx, fy = (f * (1 + shape.get("xi", 0.0)) for f in (fx, fy))
        values = {"f": (fx + fy) / 2, "fx": fx, "fy": fy, "cx": cx, "cy": cy, **shape}
        names = camera.model_info.param_names
        params: Vector = np.array([values.get(name, old) for name, old in zip(names, camera.params, strict=True)])
        return camera.with_params(params)

    def from_other_shape(self, camera: Camera) -> tuple[Lens, Camera]:
        """The lens that starts with the other shape, and its camera for one that starts with this one's."""
        other = dataclasses.replace(self, shape=self.other_shape, other_shape=())
        fx, fy = (f / (1 + dict(self.shape).get("xi", 0.0)) for f in camera.focal_lengths)
        return other, other.camera(camera.width, camera.height, fx, fy, *camera.principal_point)


_F, _FXY, _C = ("f",), ("fx", "fy"), ("cx", "cy")
_RATIONAL, _PRISM = ("k4", "k5", "k6"), ("s1", "s2", "s3", "s4")

LENSES: tuple[Lens, ...] = (
    Lens("pinhole", "PINHOLE", ((*_FXY, *_C),)),
    Lens("simple_radial", "SIMPLE_RADIAL", ((*_F, *_C, "k"),)),
    Lens("radial", "RADIAL", ((*_F, *_C, "k1", "k2"),)),
    Lens("opencv4", "OPENCV", ((*_FXY, *_C, "k1", "k2"), ("p1", "p2"))),
    Lens("opencv5", "FULL_OPENCV", ((*_FXY, *_C, "k1", "k2"), ("p1", "p2", "k3"))),
    Lens("opencv8", "FULL_OPENCV", ((*_FXY, *_C, "k1", "k2"), ("p1", "p2", "k3"), _RATIONAL), at_once=True),
    Lens(
        "opencv12",
        "FULL_OPENCV_THIN_PRISM",
        ((*_FXY, *_C, "k1", "k2"), ("p1", "p2", "k3"), (*_RATIONAL, *_PRISM)),
        at_once=True,
        rival=((*_FXY, *_C, "k1", "k2"), ("p1", "p2", "k3", *_RATIONAL, *_PRISM)),
    ),
    Lens("fisheye", "OPENCV_FISHEYE", (_FXY, (*_C, "k1", "k2"), ("k3", "k4")), start="wide"),
    Lens("eucm", "EUCM", (_FXY, (*_C, "alpha", "beta")), start="wide", shape=(("alpha", 0.5), ("beta", 1.0))),
    Lens(
        "double_sphere",
        "DOUBLE_SPHERE",
        (_FXY, (*_C, "xi", "alpha")),
        start="wide",
        shape=(("xi", -0.2), ("alpha", 0.5)),
        other_shape=(("xi", 0.3), ("alpha", 0.65)),
        spare=(("xi", 0.0),),
    ),
    Lens("division", "EUCM", (_FXY, (*_C, "beta")), start="wide", shape=(("alpha", 0.5), ("beta", 1.0))),
)

_BY_NAME = {lens.name: lens for lens in LENSES}


def lens_called(name: str) -> Lens:
    """The row of the table called `name`, or the one that estimates all parameters of COLMAP's model of that name.

    Capitals, - and _ make no difference. So `opencv` is COLMAP's OPENCV with k1, k2, p1, p2, in the whole of Parallax;
    the five coefficients that OpenCV estimates by default are opencv5.

    Raises:
        ValueError: there is none.
    """
    word = name.strip().lower().replace("-", "_")
    if word in _BY_NAME:
        return _BY_NAME[word]
    for lens in LENSES:
        model = model_by_name(lens.model)
        if word == model.name.lower() and lens.free_names == model.param_names:
            return lens
    models = dict.fromkeys(lens.model for lens in LENSES)
    raise ValueError(f"unknown lens model {name!r}; known are {', '.join(_BY_NAME)}, and COLMAP's {', '.join(models)}")


def lens_by_name(name: str) -> Lens:
    """The row of the table called `name`.

    Raises:
        ValueError: there is none.
    """
    if name not in _BY_NAME:
        raise ValueError(f"unknown lens model {name!r}; known are {', '.join(_BY_NAME)}")
    return _BY_NAME[name]
