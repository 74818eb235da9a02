"""Cut a pair into keyframes for the filter, the smoother and the batch solve."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dmrl.estimation.model.odometry import RelativeMotion, preintegrate
from dmrl.estimation.model.pair import MAX_DROPOUT_S, Array, Mask, Pair
from dmrl.estimation.signals.jump_detection import step_offsets
from dmrl.estimation.solver.camera_residuals import CameraMeasurements, camera_measurements

KEYFRAME_HZ = 10.0
"""Keyframes per second, Hz. No record of how the value was chosen."""
RANGE_BLOCK_S, RANGE_MEDIAN_BLOCKS = 0.1, 3
"""Length of the blocks of ranges, seconds, and the number of block medians on either side of a
step. No record of how the values were chosen."""
MIN_RANGE_STEP_M = 0.45
"""Smallest detected step of the ranges, metres. Smaller steps are left to the solve. Added for
bursts of long ranges; no record of how the value was chosen."""
CLOCK_HALF_STEP_S = 0.02
"""Half the time difference of the numeric derivative by the peer's clock, seconds. No record of how
the value was chosen."""


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Noise model of the sensors; one standard deviation each unless a unit shows otherwise.

    Parameters
    ----------
    velocity_std_mps, velocity_tau_s
        Coloured noise of either robot's velocity, per axis, and its correlation time.
    velocity_white_psd
        White noise of either velocity: variance per second of integration, m^2/s.
    yaw_rate_psd
        White noise of either yaw rate, rad^2/s.
    range_std_m
        White noise of a range.
    range_loss_scale_m
        Residual at which a range has half its weight.
    range_error_std_m, range_tau_s
        Coloured noise of the ranges, and its correlation time.
    range_step_sigmas
        Change of that noise at which a step has half its weight, in standard deviations. The loss
        lets the error jump.
    range_error_loss_scale_m, range_error_weight
        Weak prior that pulls the coloured range error back to zero at every keyframe: the error at
        which it has half its weight, and the weight.
    bias_std_m, scale_std
        Offset and scale of a pair's ranges.
    gyro_std_radps
        Bias of either yaw rate.
    velocity_scale_std, velocity_bias_std_mps
        Scale and bias of either velocity.
    clock_std_s
        Offset of the peer's clock.
    height_std_m
        Height difference.
    dropout_speed_mps, dropout_turn_radps
        Motion of a robot during a dropout of its sensors, per square root of a second.
    calibrated_std
        Constants of the flight, in the order of ``GLOBALS``, as known from other flights. Empty: no
        calibration.
    """

    velocity_std_mps: float = 0.08
    velocity_tau_s: float = 0.3
    velocity_white_psd: float = 2e-4
    yaw_rate_psd: float = 1e-5
    range_std_m: float = 0.12
    range_loss_scale_m: float = 0.15
    range_error_std_m: float = 0.02
    range_tau_s: float = 200.0
    range_step_sigmas: float = 1.0
    range_error_loss_scale_m: float = 0.05
    range_error_weight: float = 0.02
    bias_std_m: float = 0.15
    scale_std: float = 0.02
    gyro_std_radps: float = 0.003
    velocity_scale_std: float = 0.05
    velocity_bias_std_mps: float = 0.02
    clock_std_s: float = 0.02
    height_std_m: float = 0.04
    dropout_speed_mps: float = 0.5
    dropout_turn_radps: float = 0.5
    calibrated_std: tuple[float, ...] = ()

    @property
    def velocity_psd(self) -> float:
        """Low-frequency noise of either velocity: variance per second, m^2/s."""
        return 2 * self.velocity_tau_s * self.velocity_std_mps**2 + self.velocity_white_psd

    def scaled_by(self, grade: float, constants: float | None = None) -> "NoiseModel":
        """Return the model with scaled velocity noise and scaled priors of the constants.

        Parameters
        ----------
        grade
            Factor of the velocity noise.
        constants
            Factor of the priors of the scales. None: the same factor.
        """
        worse = grade if constants is None else constants
        return replace(
            self,
            velocity_std_mps=self.velocity_std_mps * grade,
            velocity_white_psd=self.velocity_white_psd * grade**2,
            scale_std=self.scale_std * worse,
            velocity_scale_std=self.velocity_scale_std * worse,
        )

    def with_range_noise(self, times: float) -> "NoiseModel":
        """Return the model with the white range noise multiplied by a factor."""
        return replace(
            self,
            range_std_m=self.range_std_m * times,
            range_loss_scale_m=self.range_loss_scale_m * times,
        )

    def prior_std(self) -> Array:
        """Return (11,) prior standard deviations of the constants, in the order of ``GLOBALS``."""
        pairwise = [self.gyro_std_radps] * 2 + [self.velocity_scale_std] * 2
        velocity = [self.velocity_bias_std_mps] * 4
        usual = [self.bias_std_m, self.scale_std, *pairwise, *velocity, self.clock_std_s]
        return np.minimum(usual, self.calibrated_std or np.inf)


GLOBALS = (
    "range_bias_m",
    "range_scale",
    "own_gyro_bias_radps",
    "peer_gyro_bias_radps",
    "own_velocity_scale",
    "peer_velocity_scale",
    "own_vx_bias_mps",
    "own_vy_bias_mps",
    "peer_vx_bias_mps",
    "peer_vy_bias_mps",
    "peer_clock_s",
)
"""Constants of a flight, in the order of every vector of globals."""


@dataclass(frozen=True, slots=True)
class KeyframeProblem:
    """A pair cut into K keyframes, with R ranges.

    Parameters
    ----------
    keyframe_s
        (K,) times of the keyframes, seconds.
    own, peer
        K - 1 motions from each keyframe to the next.
    peer_clock_derivative
        (K - 1, 2) derivative of the peer's shift by its clock offset, m/s.
    dropout_s
        (K - 1,) part of the interval, in seconds, with a dropout of velocity or yaw rate.
    dropout
        (K,) whether any sensor of a robot, heights included, dropped out for over half a second.
    range_dropout
        (K,) whether the ranges dropped out.
    range_keyframe
        (R,) keyframe at or before each range.
    range_m
        (R,) measured ranges, metres.
    own_to_range, peer_to_range
        R motions from that keyframe to the range.
    range_offset_guess_m
        (R,) detected step offset of the ranges, metres: a first guess.
    height_m
        (R,) peer's height minus the observer's, metres.
    camera
        Camera measurements. None: no images.
    calibrated_std
        As in `Pair`.
    """

    keyframe_s: Array
    own: RelativeMotion
    peer: RelativeMotion
    peer_clock_derivative: Array
    dropout_s: Array
    dropout: Mask
    range_dropout: Mask
    range_keyframe: NDArray[np.intp]
    range_m: Array
    own_to_range: RelativeMotion
    peer_to_range: RelativeMotion
    range_offset_guess_m: Array
    height_m: Array
    camera: CameraMeasurements | None = None
    calibrated_std: Array | None = None

    @property
    def steps_s(self) -> Array:
        """(K - 1,) seconds between keyframes."""
        return np.diff(self.keyframe_s)


def build_keyframes(pair: Pair, rate_hz: float = KEYFRAME_HZ) -> KeyframeProblem:
    """Build the keyframes of a pair.

    Parameters
    ----------
    pair
        Sensor data of both robots.
    rate_hz
        Keyframes per second.
    """
    grid = pair.time_s
    count = max(2, int((grid[-1] - grid[0]) * rate_hz) + 1)
    key_s = grid[0] + np.arange(count) / rate_hz
    key_s = np.minimum(key_s, grid[-1])
    own, peer = preintegrate(pair.own, grid), preintegrate(pair.peer, grid)
    start, end = key_s[:-1], key_s[1:]
    range_key = np.clip(np.searchsorted(key_s, pair.range_time_s, "right") - 1, 0, count - 1)
    early, late = (np.clip(edge - CLOCK_HALF_STEP_S, grid[0], grid[-1]) for edge in (start, end))
    early_2, late_2 = (
        np.clip(edge + CLOCK_HALF_STEP_S, grid[0], grid[-1]) for edge in (start, end)
    )
    before, after = peer.relative_motion(early, late), peer.relative_motion(early_2, late_2)
    gap = np.interp(end, grid, np.cumsum((pair.own.dropout | pair.peer.dropout) * pair.dt_s))
    height = pair.peer.height_m - pair.own.height_m
    return KeyframeProblem(
        keyframe_s=key_s,
        own=own.relative_motion(start, end),
        peer=peer.relative_motion(start, end),
        peer_clock_derivative=(after.shift_m - before.shift_m) / (2 * CLOCK_HALF_STEP_S),
        dropout_s=np.diff(gap, prepend=0.0),
        dropout=odometry_dropout(pair, key_s),
        range_dropout=range_dropout(pair, key_s),
        range_keyframe=range_key,
        range_m=pair.range_m,
        own_to_range=own.relative_motion(key_s[range_key], pair.range_time_s),
        peer_to_range=peer.relative_motion(key_s[range_key], pair.range_time_s),
        range_offset_guess_m=range_step_offsets(pair),
        height_m=np.interp(pair.range_time_s, grid, height),
        camera=camera_measurements(pair, key_s, NoiseModel().height_std_m),
        calibrated_std=pair.calibrated_std,
    )


def odometry_dropout(pair: Pair, time_s: Array) -> Mask:
    """Return (K,) whether a sensor of either robot dropped out for over half a second.

    Parameters
    ----------
    pair
        Sensor data of both robots.
    time_s
        (K,) times to test, seconds.
    """
    gap = pair.own.dropout | pair.peer.dropout
    for track in (pair.own, pair.peer):
        if track.height_dropout is not None:
            gap = gap | track.height_dropout
    low = np.clip(np.searchsorted(pair.time_s, time_s, "right") - 1, 0, len(gap) - 2)
    return np.asarray(gap[low] | gap[low + 1])


def range_dropout(pair: Pair, time_s: Array) -> Mask:
    """Return (K,) whether the ranges dropped out for over half a second.

    Parameters
    ----------
    pair
        Sensor data of both robots.
    time_s
        (K,) times to test, seconds.
    """
    edges = np.concatenate([[-np.inf], pair.range_time_s, [np.inf]])
    after = np.clip(np.searchsorted(edges, time_s), 1, len(edges) - 1)
    return np.asarray(edges[after] - edges[after - 1] > MAX_DROPOUT_S)


def range_step_offsets(pair: Pair) -> Array:
    """Return (R,) the detected step offset of every range, metres.

    Parameters
    ----------
    pair
        Sensor data of both robots.
    """
    if not len(pair.range_m):
        return pair.range_m
    block = ((pair.range_time_s - pair.time_s[0]) / RANGE_BLOCK_S).astype(int)
    blocks, inverse = np.unique(block, return_inverse=True)
    ends = np.cumsum(np.bincount(inverse, minlength=len(blocks)))
    middle = np.array([np.median(part) for part in np.split(pair.range_m, ends[:-1])])
    return step_offsets(middle, RANGE_BLOCK_S, MIN_RANGE_STEP_M, RANGE_MEDIAN_BLOCKS)[inverse]
