"""The bound equals a closed form, and a smoother that knows the noise reaches it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve

from dmrl.flight import NOISE, Clock, Flight, Noise, Ranges, Scenario, Truth, simulate
from dmrl.flight.bound import compute_bound, compute_range_information
from dmrl.geometry.frames import Array

LINK = ("cf1", "cf2")


def _build_still_truth(place_m: tuple[float, float, float], time_s: Array) -> Truth:
    """Return the true path of a robot that does not move."""
    none = np.zeros(len(time_s))
    place = np.tile(np.array(place_m), (len(time_s), 1))
    return Truth(time_s, place, np.zeros((len(time_s), 3)), none, none, none)


def _build_still_flight(duration_s: float, rate_hz: float) -> Flight:
    """Return a flight of two robots at rest, 2 m apart along x, with ranges of one direction."""
    time_s = np.arange(round(100 * duration_s) + 1) / 100
    truth = {
        "cf1": _build_still_truth((0, 0, 1), time_s),
        "cf2": _build_still_truth((2, 0, 1), time_s),
    }
    ranged = np.arange(0.001, duration_s, 1 / rate_hz)
    ranges = {LINK: Ranges(ranged, ranged), LINK[::-1]: Ranges(np.empty(0), np.empty(0))}
    return Flight(dict.fromkeys(truth), truth, ranges, dict.fromkeys(truth, Clock()))  # type: ignore[arg-type]


def test_bound_of_a_random_walk_in_white_noise_equals_closed_form() -> None:
    noise = Noise(uwb_white_m=0.1, velocity_white_mps=0.3)
    bound = compute_bound(_build_still_flight(40.0, 50.0), noise, yaw_spread_rad=0.0)
    step_s = 0.2
    walk, measured = 2 * 0.3**2 * step_s / 100, 0.1**2 / (50 * step_s)
    # Fixed point of the Riccati equation, then forward and backward filter combined.
    predicted = (walk + np.sqrt(walk**2 + 4 * walk * measured)) / 2
    filtered = predicted * measured / (predicted + measured)
    smoothed = 1 / (1 / filtered + 1 / predicted)
    middle = bound.interpolate_at(LINK, np.array([20.0]))[0]
    assert middle[0, 0] == pytest.approx(smoothed, rel=0.01)
    # Across the line of sight only the prior at the start and the random walk matter.
    assert middle[1, 1] == pytest.approx(1.5**2 + 2 * 0.3**2 * 20.0 / 100, rel=0.01)


def test_range_bias_and_scale_limit_the_bound_of_many_ranges() -> None:
    noise = Noise(uwb_white_m=0.1, uwb_bias_m=0.05, uwb_scale=0.02, velocity_white_mps=1e-3)
    place = compute_bound(_build_still_flight(40.0, 50.0), noise, 0.0).interpolate_at(
        LINK, np.zeros(1)
    )
    constants = 0.05**2 + (2 * 0.02) ** 2 + 0.1**2 / 2000
    assert place[0, 0, 0] == pytest.approx(1 / (1 / constants + 1 / 1.5**2), rel=0.02)


def test_information_of_a_range_has_its_whole_density() -> None:
    white = Noise(uwb_white_m=0.1)
    assert compute_range_information(white) == pytest.approx(100.0, rel=1e-4)
    # Detours far longer than the noise are outliers; the remaining 80 % keep their information.
    apart = replace(white, nlos_share=0.2, nlos_mean_m=5.0)
    assert 75.0 < compute_range_information(apart) < 80.0
    # Detours far shorter than the noise only change its mean.
    short = replace(white, nlos_share=0.2, nlos_mean_m=0.002)
    assert compute_range_information(short) == pytest.approx(100.0, rel=0.01)


@pytest.mark.heavy
def test_silent_ranges_and_a_third_robot_change_the_bound() -> None:
    noise = NOISE["calibrated"]
    scenario = Scenario(robots=3, duration_s=30.0, trajectory="random")
    flight, alone = simulate(scenario, noise, 1), simulate(replace(scenario, robots=2), noise, 1)
    middle = np.array([15.0])

    def at(flown: Flight) -> float:
        return float(np.trace(compute_bound(flown, noise).interpolate_at(LINK, middle)[0]))

    assert at(flight) < 0.95 * at(alone)
    silent = {
        link: Ranges(r.time_s[abs(r.time_s - 15) > 5], r.range_m)
        for link, r in alone.ranges.items()
    }
    assert at(replace(alone, ranges=silent)) > 1.5 * at(alone)


def test_clock_uncertainty_widens_the_bound_of_a_moving_peer() -> None:
    flight = simulate(Scenario(duration_s=30.0), NOISE["calibrated"], 3)
    exact, off = (
        compute_bound(flight, replace(NOISE["calibrated"], clock_offset_s=s)) for s in (0.0, 0.5)
    )
    for link, covariance in exact.covariances.items():
        grown = np.trace(off.covariances[link] - covariance, axis1=1, axis2=2)
        assert grown.min() > -1e-9
        assert grown.max() > 1e-6


@pytest.mark.heavy
def test_optimal_smoother_reaches_the_bound() -> None:
    squared, bounds, distances = [], [], []
    for seed in range(FLIGHTS):
        flight = simulate(Scenario(duration_s=20.0), NOISE["calibrated"], 300 + seed)
        bound = compute_bound(flight, NOISE["calibrated"], step_s=KEY_S)
        solved = _Smoother(flight, NOISE["calibrated"]).solve()
        for link, (i, j) in ((LINK, (0, 1)), (LINK[::-1], (1, 0))):
            away = solved[:, j, :2] - solved[:, i, :2]
            c, s = np.cos(solved[:, i, 2]), np.sin(solved[:, i, 2])
            found = np.stack([c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]], 1)
            error = found - flight.peer_in_horizontal(*link, bound.time_s)[:, :2]
            covariance = bound.covariances[link]
            squared.append((error**2).sum(axis=1))
            bounds.append(np.trace(covariance, axis1=1, axis2=2))
            distances.append(np.einsum("ka,kab,kb->k", error, np.linalg.inv(covariance), error))
    ratio = np.sqrt(np.mean(squared) / np.mean(bounds))
    # Errors within a flight are correlated, so 24 flights determine the ratio to about 10 %.
    assert 0.85 < ratio < 1.15
    assert 1.6 < np.mean(distances) < 2.5


FLIGHTS, KEY_S, ROUNDS = 24, 0.1, 8


class _Smoother:
    """Maximum a posteriori solve of poses, coloured errors and constants, started at the truth.

    It has its own model of the logs and numerical derivatives, so that it shares only the noise
    parameters with the bound.
    """

    def __init__(self, flight: Flight, noise: Noise) -> None:
        self.noise, self.names = noise, list(flight.robots)
        truths = list(flight.truth.values())
        self.key_s = np.arange(0.0, truths[0].time_s[-1] + KEY_S / 2, KEY_S)
        self.count = len(self.key_s)
        self.steps = [self._integrate(flight, name) for name in self.names]
        self.start = np.array([[*t.position[0, :2], t.yaw[0]] for t in truths])
        self.true = np.stack(
            [
                np.column_stack(
                    [
                        t.position_at(self.key_s)[:, :2],
                        t.yaw_at(self.key_s),
                        np.zeros((self.count, 2)),
                    ]
                )
                for t in truths
            ],
            axis=1,
        )
        links = [(LINK, 0), (LINK[::-1], 1)]
        time_s = np.concatenate([flight.ranges[link].time_s for link, _ in links])
        self.range_m = np.concatenate([flight.ranges[link].range_m for link, _ in links])
        self.at = np.clip((time_s / KEY_S).astype(int), 0, self.count - 2)
        self.share = (time_s - self.key_s[self.at]) / KEY_S
        heights = [
            np.interp(time_s, log.time_s, np.convolve(log.height_m, np.ones(51) / 51, "same"))
            for log in flight.robots.values()
        ]
        # Smoothing biases the heights at both ends, so there true heights plus bias are used.
        ends = (time_s < 0.5) | (time_s > self.key_s[-1] - 0.5)
        for k, log in enumerate(flight.robots.values()):
            bias = float(np.mean(log.height_m - truths[k].position[:, 2]))
            heights[k][ends] = (truths[k].position_at(time_s)[:, 2] + bias)[ends]
        self.lift = heights[1] - heights[0]
        self._tabulate_density()

    def _integrate(self, flight: Flight, name: str) -> tuple[Array, Array, Array]:
        """Return turn, displacement and effect of a velocity bias per step, frame of its start."""
        log, each = flight.robots[name], round(100 * KEY_S)
        turn = np.concatenate([[0.0], np.cumsum(log.yaw_rate_radps[:-1] + log.yaw_rate_radps[1:])])
        turn /= 200
        index = np.arange(self.count - 1)[:, None] * each + np.arange(each + 1)
        angle = turn[index] - turn[index[:, :1]]
        rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        velocity = np.stack([log.vx_mps, log.vy_mps])[:, index]
        moved = np.einsum("abkt,bkt->kat", rotation, velocity)
        weights = np.full(each + 1, 0.01)
        weights[[0, -1]] = 0.005
        bias = np.einsum("abkt,t->kab", rotation, weights)
        return angle[:, -1], moved @ weights, bias

    def _tabulate_density(self) -> None:
        """Tabulate residuals of range errors whose squares are twice the exact cost."""
        n = self.noise
        step = 0.001
        error = np.arange(-2.0, 6.0, step)
        white = np.exp(-((error / n.uwb_white_m) ** 2) / 2)
        tail = np.exp(-np.arange(0.0, 6.0, step) / n.nlos_mean_m) * step / n.nlos_mean_m
        detour = np.convolve(white, tail)[: len(error)]
        cost = -np.log((1 - n.nlos_share) * white + n.nlos_share * detour + 1e-300)
        mode = int(np.argmin(cost))
        self.errors = error
        self.roots = np.sign(error - error[mode]) * np.sqrt(2 * (cost - cost[mode]))

    def _residuals(self, state: Array, constants: Array) -> tuple[Array, Array]:
        """Return all residuals, and the step that each belongs to, -1 for priors."""
        n, found, where = self.noise, [], []
        tau, s = n.velocity_tau_s, n.velocity_coloured_mps
        keep = np.exp(-KEY_S / tau)
        place = n.velocity_white_mps**2 * KEY_S / 100 + 2 * s**2 * tau * (
            KEY_S - 2 * tau * (1 - keep) + tau * (1 - keep**2) / 2
        )
        spread = np.array([[place, s * tau * (1 - keep) ** 2], [0, 1 - keep**2]])
        spread[1, 0] = spread[0, 1]
        whiten = np.linalg.inv(np.linalg.cholesky(spread))
        for k in range(2):
            scale, bx, by, gyro, _ = constants[5 * k : 5 * k + 5]
            turn, moved, biased = self.steps[k]
            x, y, yaw, *error = state[:, k].T
            slow = np.stack(error, axis=1)
            bias = np.array([bx, by]) * n.velocity_bias_mps
            mid = turn / 2
            rotation = np.array([[np.cos(mid), -np.sin(mid)], [np.sin(mid), np.cos(mid)]])
            body = moved - biased @ bias
            away = np.stack([np.diff(x), np.diff(y)], axis=1)
            c, si = np.cos(yaw[:-1]), np.sin(yaw[:-1])
            away = np.stack([c * away[:, 0] + si * away[:, 1], c * away[:, 1] - si * away[:, 0]], 1)
            lack = body - (1 + n.velocity_scale * scale) * away  # integral of the velocity error
            lack = np.einsum("bak,kb->ka", rotation, lack) - s * tau * (1 - keep) * slow[:-1]
            fresh = slow[1:] - keep * slow[:-1]
            found += list(whiten @ np.stack([lack[:, 0], fresh[:, 0]]))
            found += list(whiten @ np.stack([lack[:, 1], fresh[:, 1]]))
            yawing = np.diff(yaw) - turn + gyro * n.yaw_rate_bias_radps * KEY_S
            found.append(yawing / (n.yaw_rate_white_radps * np.sqrt(KEY_S / 100)))
            where += [np.arange(self.count - 1)] * 5
            first = np.array([1.5, 1.5, np.pi / np.sqrt(3)]) if k else np.full(3, 1e-3)
            centre = np.array([1.25, 0.0, 0.0]) if k else self.start[0]
            found += [(state[0, k, :3] - centre) / first, state[0, k, 3:]]
            where += [np.zeros(5, int)]
        way = state[:, 1, :2] - state[:, 0, :2]
        way = way[self.at] * (1 - self.share[:, None]) + way[self.at + 1] * self.share[:, None]
        lift = self.lift - n.height_bias_m * (constants[9] - constants[4])
        distance = np.sqrt((way**2).sum(axis=1) + lift**2)
        bias_m, scale = n.uwb_bias_m * constants[10], 1 + n.uwb_scale * constants[11]
        found.append(np.interp(self.range_m - scale * distance - bias_m, self.errors, self.roots))
        where.append(self.at)
        return np.concatenate([*found, constants]), np.concatenate([*where, np.full(12, -1)])

    def solve(self) -> Array:
        """Return (K, 2, 5) poses and coloured errors."""
        state, constants, small = self.true.copy(), np.zeros(12), 1e-6
        width = state[0].size
        for _ in range(ROUNDS):
            base, where = self._residuals(state, constants)
            entries = []
            for part in range(3):
                mine = np.arange(self.count) % 3 == part
                # A residual depends on two successive steps, so every third step can be
                # perturbed at once.
                seen = np.where(
                    where % 3 == part, where, np.where((where + 1) % 3 == part, where + 1, -1)
                )
                seen[where < 0] = -1
                for k in range(width):
                    moved = state.copy().reshape(self.count, width)
                    moved[mine, k] += small
                    there, _ = self._residuals(moved.reshape(state.shape), constants)
                    column = np.where(seen < 0, -1, seen * width + k)
                    entries.append(_nonzero((there - base) / small, column))
            for k in range(12):
                moved = constants.copy()
                moved[k] += small
                there, _ = self._residuals(state, moved)
                column = np.full(len(base), state.size + k)
                entries.append(_nonzero((there - base) / small, column))
            shape = (len(base), state.size + 12)
            rows, columns, values = (np.concatenate(part) for part in zip(*entries, strict=True))
            slope = coo_array((values, (rows, columns)), shape).tocsc()
            step = -spsolve((slope.T @ slope).tocsc(), slope.T @ base)
            state = state + step[:-12].reshape(state.shape)
            constants = constants + step[-12:]
        return state


def _nonzero(effect: Array, column: Array) -> tuple[Array, Array, Array]:
    """Return rows, columns and values of the non-zero derivatives."""
    used = np.flatnonzero((column >= 0) & (effect != 0))
    return used, column[used], effect[used]
