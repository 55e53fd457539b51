"""The table of shapes a scene is made of, and a builder that fills it object by object."""

import enum
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


class Shape(enum.IntEnum):
    """Convex bodies; each fills the unit ball of its norm, scaled by `half_size` and turned by `yaw`."""

    BOX = 0
    CYLINDER = 1
    ELLIPSOID = 2


class Label(enum.IntEnum):
    """What a surface belongs to."""

    GROUND = 0
    BUILDING = 1
    WALL = 2
    FENCE = 3
    VEHICLE = 4
    POLE = 5
    VEGETATION = 6
    PEDESTRIAN = 7
    KERB = 8
    RAIL = 9
    CLUTTER = 10


class Primitives(NamedTuple):
    """Shapes in the flat world; positions are those at time 0."""

    shape: Int[np.ndarray, " n"]
    center: Float[np.ndarray, "n 3"]
    half_size: Float[np.ndarray, "n 3"]
    yaw: Float[np.ndarray, " n"]
    velocity: Float[np.ndarray, "n 2"]
    """Along x and y [m/s]; zero for what stands still."""
    opacity: Float[np.ndarray, " n"]
    """Share of rays that it stops."""
    softness: Float[np.ndarray, " n"]
    """Mean depth below the surface at which a ray is returned [m]."""
    reflectance: Float[np.ndarray, " n"]
    object_id: Int[np.ndarray, " n"]
    """1 and up; shapes of one object share it."""
    label: Int[np.ndarray, " n"]


def take(primitives: Primitives, index: np.ndarray) -> Primitives:
    """The rows chosen by a mask or an index."""
    return Primitives(*(field[index] for field in primitives))


def concatenate(parts: list[Primitives]) -> Primitives:
    """All rows of several tables."""
    return Primitives(*(np.concatenate(fields) for fields in zip(*parts, strict=True)))


class Builder:
    """Collects shapes object by object: `begin` places a new object, `add` gives it shapes in its own frame."""

    def __init__(self, rng: np.random.Generator, first_id: int = 1):
        self.rng = rng
        self.next_id = first_id
        self._rows: list[tuple] = []

    def begin(
        self,
        label: Label,
        x: float,
        y: float,
        yaw: float = 0.0,
        *,
        reflectance: float = 0.3,
        velocity: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Start an object whose frame stands on the ground at (x, y), turned by `yaw`."""
        self._head = (self.next_id, int(label))
        self._x, self._y, self._yaw = x, y, yaw
        self._cos, self._sin = float(np.cos(yaw)), float(np.sin(yaw))
        self._velocity = velocity
        self._reflectance = reflectance * float(np.exp(self.rng.normal(0.0, 0.4)))
        self.next_id += 1

    def add(
        self,
        shape: Shape,
        center: tuple[float, float, float],
        half_size: tuple[float, float, float],
        *,
        yaw: float = 0.0,
        opacity: float = 1.0,
        softness: float = 0.0,
        dim: float = 1.0,
    ) -> None:
        """Add one shape; `dim` scales the object's reflectance."""
        x = self._x + self._cos * center[0] - self._sin * center[1]
        y = self._y + self._sin * center[0] + self._cos * center[1]
        tail = (*self._velocity, opacity, softness, self._reflectance * dim)
        self._rows.append((int(shape), *self._head, x, y, center[2], *half_size, self._yaw + yaw, *tail))

    def box(self, x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], **surface: float) -> None:
        """Add a box by its bounds in the object's frame."""
        center, half_size = zip(*((0.5 * (low + high), 0.5 * (high - low)) for low, high in (x, y, z)), strict=True)
        self.add(Shape.BOX, center, half_size, **surface)

    def post(self, x: float, y: float, radius: float, z: tuple[float, float], **surface: float) -> None:
        """Add a vertical cylinder."""
        half_height = 0.5 * (z[1] - z[0])
        self.add(Shape.CYLINDER, (x, y, z[0] + half_height), (radius, radius, half_height), **surface)

    def crown(self, x: float, y: float, z: float, radius: float, height: float, mean_free_path: float) -> None:
        """Add foliage: an upright ellipsoid, `height` its half height, that returns rays from its inside."""
        self.add(Shape.ELLIPSOID, (x, y, z), (radius, radius, height), softness=mean_free_path)

    def build(self) -> Primitives:
        """The table of everything added."""
        rows = np.array(self._rows, dtype=np.float64).reshape(-1, 15)
        shape, object_id, label = rows[:, :3].astype(np.int32).T
        return Primitives(
            shape=shape,
            center=rows[:, 3:6],
            half_size=np.maximum(rows[:, 6:9], 1e-3),
            yaw=rows[:, 9],
            velocity=rows[:, 10:12],
            opacity=rows[:, 12],
            softness=rows[:, 13],
            reflectance=rows[:, 14],
            object_id=object_id,
            label=label,
        )
