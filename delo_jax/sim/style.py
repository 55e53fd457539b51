"""What a drive's road looks like: cross-section, traffic, and the odds of what lines it."""

from typing import NamedTuple

import numpy as np

from delo_jax.sim import buildings

# Odds of what lines a stretch of road: facades, houses, walls, hedges, fences, parking lots, parks, fields,
# rows of trees, bushes, noise walls.
FRONTS = ("facades", "houses", "wall", "hedge", "fence", "parking", "park", "field", "treeline", "bushes", "noise_wall")
ODDS = {
    "urban": (12, 1, 1, 0.3, 0.5, 1, 1.5, 0, 0.7, 0.3, 0),
    "residential": (2, 12, 1, 1.5, 1, 0.5, 1, 0.5, 0.7, 0.7, 0),
    "mixed": (2, 3, 1.5, 1.5, 1.5, 1.5, 1.5, 1.5, 1.5, 1.5, 0.7),
    "road": (0.5, 0.5, 0.5, 0.3, 1, 0.5, 0.5, 4, 2.5, 2.5, 2.5),
    "open": (0, 0, 0, 0, 0.7, 0, 0.3, 3, 3, 3.5, 0),
}


class Lane(NamedTuple):
    """One lane of other traffic."""

    y: float
    speed: float
    """All its vehicles are equally fast [m/s]; 0 is a queue."""
    oncoming: bool

    @property
    def velocity(self) -> float:
        """Along x [m/s]."""
        return -self.speed if self.oncoming else self.speed


class Style(NamedTuple):
    """What a drive's road looks like; y of the edges as seen from the vehicle's lane."""

    kind: str
    odds: tuple[float, ...]
    left_edge: float
    right_edge: float
    left_front: float
    """Where private ground begins; between edge and front lie parking and sidewalk."""
    right_front: float
    lanes: tuple[Lane, ...]
    traffic_gap: float
    kerb_height: float
    parking: float
    """Share of the parking slots that is taken; 0 without parking."""
    parking_depths: tuple[float, float]
    """Of the slots left and right: cars stand along the road or, where it is deep, across it [m]."""
    cross_street_chance: float
    tree_gap: float
    pole_gap: float
    people_gap: float
    clutter_gap: float
    rail_chance: float
    median_rail: bool
    tree_size: float
    facade: buildings.FacadeStyle
    height: float
    """Typical of buildings [m]."""


def draw_style(kind: str, rng: np.random.Generator) -> Style:
    """A random style of one kind."""
    town = kind in ("urban", "residential", "mixed")
    lane = rng.uniform(2.7, 3.6) if town else rng.uniform(3.2, 3.8)
    same = int(rng.choice([0, 1], p=[0.75, 0.25])) if town else int(rng.integers(0, 3))
    inner = int(rng.choice([0, 1], p=[0.85, 0.15])) if town else int(rng.integers(0, 2))
    opposite = int(rng.choice(3, p=[0.25, 0.55, 0.2])) if town else int(rng.integers(1, 4))
    median = float(rng.uniform(0.5, 4.0)) if rng.uniform() < (0.1 if town else 0.6) else 0.0
    speed = rng.uniform(3.0, 15.0) if town else rng.uniform(12.0, 33.0)
    centre = lane * (0.5 + inner)
    speed *= rng.uniform() > 0.08
    lanes = [Lane(-lane * (1 + k), speed * rng.uniform(0.7, 1.1), False) for k in range(same)]
    lanes += [Lane(lane * (1 + k), speed * rng.uniform(0.9, 1.3), False) for k in range(inner)]
    lanes += [Lane(centre + median + lane * (0.5 + k), speed * rng.uniform(0.8, 1.2), True) for k in range(opposite)]
    shoulder = rng.uniform(0.3, 1.2) if town else rng.uniform(0.5, 3.5)
    parking = rng.uniform(0.2, 1.0) if town and rng.uniform() < 0.65 else 0.0
    depths = rng.choice([0.0, 2.2, 5.0], size=2, p=[0.15, 0.7, 0.15]) * (parking > 0)
    left_edge = centre + median + lane * opposite + shoulder + depths[0]
    right_edge = -(lane * (0.5 + same) + shoulder + depths[1])
    walks = rng.uniform(0.8, 5.0, 2) + rng.uniform(0.0, 3.0) * (rng.uniform() < 0.5)
    odds = np.array(ODDS[kind]) * np.exp(rng.normal(0.0, 0.7, len(FRONTS)))
    return Style(
        kind=kind,
        odds=tuple(odds / odds.sum()),
        left_edge=max(left_edge, 2.6),
        right_edge=min(right_edge, -2.3),
        left_front=max(left_edge, 2.6) + walks[0],
        right_front=min(right_edge, -2.3) - walks[1],
        lanes=tuple(lanes),
        traffic_gap=float(np.exp(rng.uniform(np.log(15.0), np.log(200.0)))),
        kerb_height=rng.uniform(0.08, 0.18) if town and rng.uniform() < 0.85 else 0.0,
        parking=parking,
        parking_depths=(float(depths[0]), float(depths[1])),
        cross_street_chance=rng.uniform(0.1, 0.8) if town else rng.uniform(0.0, 0.2),
        tree_gap=float(np.exp(rng.uniform(np.log(6.0), np.log(60.0)))),
        pole_gap=float(np.exp(rng.uniform(np.log(12.0), np.log(60.0)))),
        people_gap=float(np.exp(rng.uniform(np.log(8.0), np.log(150.0)))) if town else 1e6,
        clutter_gap=float(np.exp(rng.uniform(np.log(5.0), np.log(80.0)))) * (1.0 if town else 3.0),
        rail_chance=rng.uniform(0.2, 1.0) if not town else rng.uniform(0.0, 0.15),
        median_rail=median > 1.0 and opposite > 0 and rng.uniform() < 0.8,
        tree_size=rng.uniform(0.5, 1.4),
        facade=buildings.draw_facade_style(rng),
        height=rng.uniform(5.0, 20.0),
    )
