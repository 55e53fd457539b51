"""All methods by name: what each is, what it needs, and how to get it."""

import dataclasses
import importlib
from collections.abc import Callable
from importlib.metadata import version

from delo_jax.baselines.gicp import Gicp, Vgicp, VgicpToMap
from delo_jax.baselines.icp import Icp, PointToPlane
from delo_jax.baselines.kiss import GenzIcp, KissIcp, KissMatcher
from delo_jax.baselines.network import Network
from delo_jax.baselines.prediction import FirstMotion, Identity, MeanMotion, Start
from delo_jax.baselines.protocols import PairMethod, ScanToScan, Tracker
from delo_jax.errors import ConfigError
from delo_jax.model.delo import Model


@dataclasses.dataclass(frozen=True, kw_only=True)
class Method:
    """One method; `pair` and `tracker` of the network take its weights."""

    name: str
    what: str
    """In a few words."""
    pair: Callable[..., PairMethod] | None = None
    """Opens it for pairs of scans; None where it is a whole odometry only."""
    tracker: Callable[..., Tracker] | None = None
    """Opens it for a drive; None where `pipeline.LidarOdometry` is that."""
    package: str | None = None
    """Distribution that it needs beside this package."""
    deterministic: bool = True
    """Whether the same drive gives the same bytes; where it does not, sums over threads differ by rounding at least."""
    uncertainty: bool = False
    """Whether it says how sure it is; else its covariances are NaN."""
    network: bool = False
    """Whether it needs weights."""
    preset: str | None = None
    """That its weights must be of; None: any."""

    @property
    def package_version(self) -> str | None:
        """Of the package that is installed."""
        return None if self.package is None else version(self.package)

    def open_pair(self, params: Model | None = None) -> PairMethod:
        """The method for pairs of scans.

        Args:
            params: weights, for those that need some.

        Raises:
            ConfigError: no pair method, a missing package, or weights of another preset or none.
        """
        if self.pair is None:
            raise ConfigError(f"method {self.name}: expected a method for pairs of scans, got one for whole drives; choose another")
        self.check(params)
        return self.pair(params) if self.network else self.pair()

    def open_tracker(self, params: Model | None = None) -> Tracker:
        """The method for a drive.

        Args:
            params: weights, for those that need some.

        Raises:
            ConfigError: as of `open_pair`.
        """
        if self.tracker is None:
            raise ConfigError(f"method {self.name}: expected a method with a tracker, got one that is LidarOdometry itself; use that")
        self.check(params)
        return self.tracker(params) if self.network else self.tracker()

    def check(self, params: Model | None = None) -> None:
        """Raises where the package is missing, or the weights are not this method's."""
        if self.package is not None:
            try:
                importlib.import_module(self.package.replace("-", "_"))
            except ImportError as error:
                what = f"expected the package {self.package}, got none; pip install 'delo-jax[baselines]'"
                raise ConfigError(f"--method {self.name}: {what}") from error
        if self.network and params is None:
            what = f"expected weights trained by `delo train {self.preset or 'base'}`, got none; give them by --weights FILE"
            raise ConfigError(f"--method {self.name}: {what}")
        if params is not None and self.preset not in (None, params.cfg.name):
            what = f"expected weights of the preset {self.preset}, got the preset {params.cfg.name}; give others by --weights FILE"
            raise ConfigError(f"--method {self.name}: {what}")


def _scan_to_scan(pair: Callable[..., PairMethod]) -> Callable[..., Tracker]:
    return lambda *params: ScanToScan(pair(*params))


_ALL = (
    Method(name="delo", what="this package: scans on a local map", pair=Network, uncertainty=True, network=True),
    Method(name="kiss-icp", what="KISS-ICP, point to point on a map", tracker=KissIcp, package="kiss-icp", deterministic=False),
    Method(name="genz-icp", what="GenZ-ICP, points and planes on a map", tracker=GenzIcp, package="genz-icp", deterministic=False),
    Method(
        name="vgicp",
        what="VGICP of small_gicp, on a map of voxels",
        pair=Vgicp,
        tracker=VgicpToMap,
        package="small_gicp",
        deterministic=False,
    ),
    Method(
        name="gicp",
        what="GICP of small_gicp, scan to scan",
        pair=Gicp,
        tracker=_scan_to_scan(Gicp),
        package="small_gicp",
        deterministic=False,
    ),
    Method(name="icp", what="point-to-point ICP, scan to scan", pair=Icp, tracker=_scan_to_scan(Icp)),
    Method(name="point-to-plane", what="point-to-plane ICP, scan to scan", pair=PointToPlane, tracker=_scan_to_scan(PointToPlane)),
    Method(
        name="kiss-matcher",
        what="KISS-Matcher, scan to scan without a prior",
        pair=KissMatcher,
        tracker=_scan_to_scan(KissMatcher),
        package="kiss-matcher",
        deterministic=False,
    ),
    Method(name="delo-paper", what="DELO as printed, scan to scan", pair=Network, uncertainty=True, network=True, preset="paper"),
    Method(name="dcp", what="DCP, scan to scan", pair=Network, tracker=_scan_to_scan(Network), network=True, preset="dcp"),
    Method(
        name="constant-velocity",
        what="the first motion, by GICP, for ever",
        pair=Start,
        tracker=FirstMotion,
        package="small_gicp",
        deterministic=False,
    ),
    Method(name="mean-motion", what="10.5 m/s straight ahead", pair=MeanMotion, tracker=MeanMotion),
    Method(name="identity", what="nothing moves", pair=Identity, tracker=Identity),
)
METHODS = {method.name: method for method in _ALL}
