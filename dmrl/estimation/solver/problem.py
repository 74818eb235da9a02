"""The problem to solve: keyframes with their odometry, ranges and images, and the noise."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.model.odometry import Odometry, RelativeMotion
from dmrl.estimation.model.pair import Array, Mask
from dmrl.estimation.solver.layout import Layout, Subject, build_layout
from dmrl.estimation.solver.robust_loss import Cauchy, Loss
from dmrl.estimation.solver.unknowns import TABLE, Unknown

Measured = TypeVar("Measured", "RangeLink", "CameraView")


CORRELATION_S = 0.3
"""Time over which a network repeats its errors, seconds: images within it count as one."""


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Noise of the measurements; the unknowns have their own in the table.

    Parameters
    ----------
    grade
        Factor of the velocity noise, relative to the defaults.
    constants_grade
        Factor of the priors of graded constants.
    velocity_psd
        White noise of a velocity: variance per second of integration, m^2/s.
    yaw_rate_psd
        White noise of a yaw rate, rad^2/s.
    range_std_m
        White noise of a range.
    height_std_m
        Height difference.
    dropout_speed_mps, dropout_turn_radps
        Motion of a robot without odometry, per square root of a second.
    range_loss, motion_loss, bearing_loss
        Losses. A radio's detour or a slipping flow is no Gaussian tail.
    known_std
        Standard deviations of constants that other flights determined, by subject.
    """

    grade: float = 1.0
    constants_grade: float = 1.0
    velocity_psd: float = 2e-4
    yaw_rate_psd: float = 1e-5
    range_std_m: float = 0.12
    height_std_m: float = 0.04
    dropout_speed_mps: float = 0.5
    dropout_turn_radps: float = 0.5
    range_loss: Loss = field(default_factory=lambda: Cauchy(1.25))
    motion_loss: Loss = field(default_factory=lambda: Cauchy(5.0))
    bearing_loss: Loss = field(default_factory=lambda: Cauchy(2.0))
    known_std: Mapping[tuple[str, tuple[int, ...]], float] = field(default_factory=dict)

    def prior_std(self, layout: Layout) -> Array:
        """Return (G,) prior standard deviations of the constants."""
        return np.array(
            [
                min(
                    row.std * (self.constants_grade if row.graded else 1.0),
                    self.known_std.get(subject, np.inf),
                )
                for subject, row in layout.constants
            ]
        )


@dataclass(frozen=True, eq=False)
class Steps:
    """Measured motion of one robot between K keyframes, S = K - 1.

    Parameters
    ----------
    steps_s
        (S,) seconds.
    motion
        S motions from each keyframe to the next.
    clock_derivative
        (S, 3) derivative of shift and turn by the robot's clock offset, per second.
    dropout_s
        (S,) seconds of each step without odometry.
    turn_dropout_s
        (S,) of these, seconds without a yaw rate.
    path
        Dead reckoning of the robot, for any time.
    height_m
        (K,) measured heights.
    noise_factor
        Factor of the white noise of the robot's velocity, beside the grade of the flight.
    grade
        (S,) factor of all noise of the velocity of each step, beside the grade of the flight.
    """

    steps_s: Array
    motion: RelativeMotion
    clock_derivative: Array
    dropout_s: Array
    turn_dropout_s: Array
    path: Odometry
    height_m: Array
    noise_factor: float = 1.0
    grade: Array | float = 1.0

    @cached_property
    def _effects(self) -> "dict[Callable[[Steps], Array], Array]":
        return {}

    def effect_of(self, motion: "Callable[[Steps], Array]") -> Array:
        """Return the (3, S) effect of an unknown on the measured motion.

        No effect depends on the values of unknowns, so all linearizations take the same.
        """
        if motion not in self._effects:
            self._effects[motion] = np.ascontiguousarray(motion(self).T)
        return self._effects[motion]


@dataclass(frozen=True, eq=False)
class RangeLink:
    """R ranges between two robots.

    Parameters
    ----------
    robots
        Indices of the two robots.
    keyframe
        (R,) keyframe nearest to each range, ascending.
    time_s, range_m
        (R,) times, seconds, and measured ranges, metres.
    std_share
        (R,) standard deviations relative to the noise model's.
    own_shift_m, peer_shift_m
        (R, 2) motion of either robot from the keyframe to the range, in its own frame.
    height_m
        (R,) height of the second robot minus that of the first.
    offset_guess_m
        (R,) detected excess of the ranges: a first guess.
    sent
        (R,) share of each range that the first robot measured: 1, 0, or one half where it is not
        known.
    """

    robots: tuple[int, int]
    keyframe: NDArray[np.intp]
    time_s: Array
    range_m: Array
    std_share: Array
    own_shift_m: Array
    peer_shift_m: Array
    height_m: Array
    offset_guess_m: Array
    sent: Array

    @cached_property
    def place(self) -> NDArray[np.intp]:
        """(R,) number of each range among those of its keyframe."""
        count = np.bincount(self.keyframe)
        return np.asarray(np.arange(len(self.keyframe)) - (np.cumsum(count) - count)[self.keyframe])

    @cached_property
    def _padded(self) -> "dict[int, PaddedRanges]":
        return {}

    def pad(self, keyframes: int) -> "PaddedRanges":
        """Return the ranges with equally many at each of a number of keyframes.

        Every linearization of a link takes the same, so they are kept.
        """
        if keyframes not in self._padded:
            most = int(self.place.max(initial=0)) + 1
            at = self.place * keyframes + self.keyframe
            kept = {"range_m": self.range_m, "std_share": self.std_share, "height_m": self.height_m}
            kept |= {"own_shift_m": self.own_shift_m, "peer_shift_m": self.peer_shift_m}
            full = {}
            for name, values in kept.items():
                # Axes are contiguous: half of the time of interleaved ones.
                out = np.full((*values.shape[1:], most * keyframes), float(name == "std_share")).T
                out[at] = values
                full[name] = out
            key = np.tile(np.arange(keyframes), most)
            weight = np.zeros((most, keyframes))
            weight.ravel()[at] = 1.0
            self._padded[keyframes] = PaddedRanges(self.robots, key, at, weight, **full)
        return self._padded[keyframes]

    def list_sights(
        self, distance: Array, offset: Array, here: Array, there: Array
    ) -> "dict[float, Sight]":
        """Return what either robot sees at the ranges, by the sides 1 and -1 of the robots.

        Parameters
        ----------
        distance, offset
            (R,) and (R, 2) from the first robot to the second, metres.
        here, there
            (R,) headings of both, radians.
        """
        return {
            1.0: Sight(distance, offset, here, self.sent),
            -1.0: Sight(distance, -offset, there, 1 - self.sent),
        }


@dataclass(frozen=True, slots=True)
class PaddedRanges:
    """Ranges of a link at K keyframes, m at each. The number of a range comes before its keyframe.

    ``keyframe``, ``range_m``, ``std_share``, ``height_m`` (m K,), ``own_shift_m`` and
    ``peer_shift_m`` (m K, 2) as in `RangeLink`; ``at`` (R,) places of the ranges of the link;
    ``weight`` (m, K) 1 for a range, 0 for a filling.
    """

    robots: tuple[int, int]
    keyframe: NDArray[np.intp]
    at: NDArray[np.intp]
    weight: Array
    range_m: Array
    std_share: Array
    height_m: Array
    own_shift_m: Array
    peer_shift_m: Array


class Sight(NamedTuple):
    """Direction and bearing at R ranges, for the owner of an unknown.

    ``distance`` (R,) true distances, metres; ``offset`` (R, 2) of the other robot in the flight's
    frame, metres; ``heading`` (R,) of the owner, radians; ``sent`` (R,) share of each range that
    the owner measured.
    """

    distance: Array
    offset: Array
    heading: Array
    sent: Array

    @property
    def bearing(self) -> Array:
        """(R,) bearing of the other robot in the owner's frame, radians."""
        return np.asarray(np.arctan2(self.offset[:, 1], self.offset[:, 0]) - self.heading)


@dataclass(frozen=True, slots=True)
class CameraView:
    """Candidate detections of one robot in another's I images.

    Parameters
    ----------
    robots
        Indices of the robot with the camera and of its peer.
    keyframe
        (I,) keyframe nearest to each image, ascending.
    own_shift_m, peer_shift_m, own_turn_rad
        (I, 2), (I, 2), (I,) motions from the keyframe to the image.
    height_m
        (I,) height of the peer minus that of the observer.
    bearing, std
        (I, C, 3) azimuth, elevation (rad) and log distance of the candidates, NaN where there are
        fewer; and their standard deviations.
    weight
        (I,) weight of an image among those with the same errors.
    time_s
        (I,) capture times, seconds.
    """

    robots: tuple[int, int]
    keyframe: NDArray[np.intp]
    own_shift_m: Array
    peer_shift_m: Array
    own_turn_rad: Array
    height_m: Array
    bearing: Array
    std: Array
    weight: Array
    time_s: Array


@dataclass(frozen=True, slots=True)
class Problem:
    """A flight of N robots at K keyframes, with the table of its unknowns.

    Parameters
    ----------
    keyframe_s
        (K,) times, seconds.
    robots, links, views
        Measured motions, ranges and detections.
    table
        Rows of the unknowns.
    noise
        Noise of the measurements.
    unused
        Unknowns of the table that this flight does not need.
    """

    keyframe_s: Array
    robots: tuple[Steps, ...]
    links: tuple[RangeLink, ...]
    views: tuple[CameraView, ...] = ()
    table: tuple[Unknown, ...] = TABLE
    noise: NoiseModel = field(default_factory=NoiseModel)
    unused: frozenset[Subject] = frozenset()

    @property
    def layout(self) -> Layout:
        """Columns of the unknowns."""
        sighted = {robot for view in self.views for robot in view.robots}
        links = [link.robots for link in self.links]
        return build_layout(self.table, len(self.robots), links, sighted, self.unused)

    def list_noisy_steps(self) -> Mask:
        """Return (S,) the steps in which some robot's velocity is noisier than elsewhere."""
        noisy = np.zeros(len(self.keyframe_s) - 1, bool)
        for steps in self.robots:
            noisy |= np.asarray(steps.grade) > 1.0
        return noisy

    @property
    def fading_psd(self) -> float:
        """Low-frequency noise of a fading velocity error: variance per second, m^2/s."""
        rows = [row for row in self.table if row.name == "velocity_error_x"]
        return sum(2 * row.time_s * (row.std * self.noise.grade) ** 2 for row in rows)

    @property
    def velocity_psd(self) -> float:
        """Low-frequency noise of a velocity: variance per second, m^2/s."""
        return self.noise.velocity_psd * self.noise.grade**2 + self.fading_psd
