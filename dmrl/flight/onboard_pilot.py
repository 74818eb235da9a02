"""Pilot of few bytes: raw detections and state in, commands out. The reference of ``pilot.c``.

One Kalman filter for one leader, in the frame of the robot's own dead reckoning, with the
probability that the filter follows it. All numbers are IEEE doubles, and all operations are +, -, *
and /, in the order of the C: both give the same commands, bit for bit.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

from dmrl.flight.onboard_arithmetic import angle_of, root, turn_of
from dmrl.flight.onboard_input import DETECTIONS_MAX, RawDetection, RobotState
from dmrl.geometry.frames import AIDECK_PINHOLE, Camera

CONSTANTS = {
    "PAST": 16,  # steps of the robot's own path that are kept
    "MAX_AGE_S": 0.6,  # an older image is not used
    "STALE_S": 1.0,  # without a younger image the robot hovers
    "BLIND_S": 1.2,  # so long after the last detection it searches
    "UNSURE_S": 3.0,  # so long after the last sure detection it stops; held leaders had up to 2.3
    "SURE": 19661,  # confidence, of 65536, of a sure detection: 0.3
    "FOUND": 32768,  # confidence, of 65536, at which a lost leader is found again: 0.5
    "LOST_ODDS": 0.2,
    "MAX_ODDS": 50.0,
    "START_ODDS": 9.0,
    "START_VAR": 0.04,  # m^2
    "SPEED_VAR": 0.09,  # (m/s)^2 along each axis
    "SPEED_S": 1.5,
    "DRIFT_VAR": 0.004,  # m^2/s, of the robot's own path
    "DEPTH_RATIO": 0.33,  # standard deviation of a depth of confidence 0, of the depth,
    "DEPTH_SURE": 0.22,  # and so much less at confidence 1
    "SIDE_RATIO": 0.02,  # radians, of a direction
    "IN_VIEW": 0.8,  # tangent of the angle off the axis within which a leader is in the image
    "SEEN_SHARE": 0.7,
    "UNSEEN_SHARE": 0.05,
    # Detections of the leader by false ones of confidence 0.5, in a radian left, a radian up and an
    # e-fold of distance; at other confidences by the square of their odds, as counted in flights,
    "EVIDENCE": 50.0,
    "OTHERS": 30.0,  # and at most so many, for the detection may be another robot's
    # Detections of the leader by those of a false object that stays where the leader is expected:
    # so many and the squared odds of the confidence. A weak one there tells as much as a miss.
    "STAYING": 0.5,
    "VIEW": 3.0,  # radians times radians times e-folds of distance in which a network sees
    "ELSEWHERE_SHARE": 0.35,  # of images in which a leader that was lost is detected
    "GATE": 20.0,  # squared residual, in variances, beyond which a detection is another object's
    "TRUST_VAR": 0.1225,  # m^2, at which it flies at half its speed
    "GAIN": 1.2,
    "CLIMB_GAIN": 0.8,
    "TURN_GAIN": 3.0,
    "SEARCH_RATE": 0.8,  # rad/s
    "SWEEP": 2.0,  # standard deviations of the leader's direction that a search shows
    "HALF_VIEW": 0.68,  # radians of them in the image when it looks at the middle
    "NEAR": 0.45,  # m
}
"""Constants of the pilot, here and in the C; lengths in metres, times in seconds."""
_K = CONSTANTS


class _Pose(NamedTuple):
    """Own pose: time, place and heading by dead reckoning, and attitude and height."""

    time_s: float
    x: float
    y: float
    c: float
    s: float
    roll: float
    pitch: float
    height: float


_START = _Pose(0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0)


class _Place(NamedTuple):
    """Place of a detection, variances, direction and distance from the camera, and its odds."""

    x: float
    y: float
    z: float
    along: float
    across: float
    upward: float
    to_x: float
    to_y: float
    away: float
    odds: float


class _Residual(NamedTuple):
    """A detection's place less the leader's, inverse covariance, likelihood by a false one's."""

    x: float
    y: float
    ixx: float
    ixy: float
    iyy: float
    likelihood: float


class _Candidate(NamedTuple):
    """A detection that may be the leader's."""

    confidence: int
    place: _Place
    residual: _Residual
    evidence: float  # detections of the leader by false ones of its confidence, anywhere
    ratio: float  # the same where it is, of the images in which the leader is detected
    most_ratio: float  # and at most so many, for it may be a false object that stays there


@dataclass(slots=True)
class OnboardFilter:
    """State of the pilot; see `step`.

    Parameters
    ----------
    distance_m
        Distance to keep.
    camera
        Pinhole camera of the detections.
    above_m
        Height to keep above the leader.
    """

    distance_m: float
    camera: Camera = AIDECK_PINHOLE
    above_m: float = 0.0
    pose: _Pose = _START
    past: list[_Pose] = field(default_factory=list)
    mean: list[float] = field(default_factory=list)
    covariance: list[list[float]] = field(default_factory=list)
    height_m: float = 0.0
    height_var: float = 0.0
    odds: float = _K["START_ODDS"]
    side: float = 1.0
    seen_s: float = 0.0
    sure_s: float = 0.0
    image_s: float = -1.0

    def step(
        self, state: RobotState, image_s: float, detections: list[RawDetection]
    ) -> tuple[float, float, float, float]:
        """Return vx, vy, vz and the yaw rate to fly.

        Parameters
        ----------
        state
            Measurements now.
        image_s
            Exposure of the newest image that has arrived; negative: none yet. An image that was
            used before, or is too old, is not used.
        detections
            Detections in it.
        """
        if not self.past:
            self._start(state)
        self._move(state)
        age_s = state.time_s - image_s
        if image_s > self.image_s and image_s >= 0.0:
            self.image_s = image_s
            if age_s <= _K["MAX_AGE_S"]:
                self._look(age_s, detections)
        return self._command(state)

    def _start(self, state: RobotState) -> None:
        """Begin with the leader ahead, at the distance and the own height."""
        self.pose = _START._replace(time_s=state.time_s)
        self._restart(self.distance_m, 0.0, state.height_m, _K["START_VAR"], state.time_s)
        self.odds = _K["START_ODDS"]

    def _restart(self, x: float, y: float, z: float, variance: float, time_s: float) -> None:
        self.mean = [x, y, 0.0, 0.0]
        diagonal = (variance, variance, _K["SPEED_VAR"], _K["SPEED_VAR"])
        self.covariance = [[diagonal[i] if i == j else 0.0 for j in range(4)] for i in range(4)]
        self.height_m, self.height_var = z, variance
        self.odds, self.seen_s, self.sure_s = 1.0, time_s, time_s

    def _move(self, state: RobotState) -> None:
        """Reckon the own pose, and predict the leader."""
        dt = state.time_s - self.pose.time_s
        turned_c, turned_s = turn_of(state.yaw_rate_radps * dt)
        c = self.pose.c * turned_c - self.pose.s * turned_s
        s = self.pose.s * turned_c + self.pose.c * turned_s
        x = self.pose.x + dt * (c * state.vx_mps - s * state.vy_mps)
        y = self.pose.y + dt * (s * state.vx_mps + c * state.vy_mps)
        attitude = state.roll_rad, state.pitch_rad, state.height_m
        self.pose = _Pose(state.time_s, x, y, c, s, *attitude)
        self.past = [self.pose, *self.past[: int(_K["PAST"]) - 1]]
        keep = 1.0 / (1.0 + dt / _K["SPEED_S"])
        m, p = self.mean, self.covariance
        self.mean = [m[0] + dt * m[2], m[1] + dt * m[3], keep * m[2], keep * m[3]]
        rows = [[p[i][j] + dt * p[i + 2][j] for j in range(4)] for i in range(2)]
        rows += [[keep * p[i][j] for j in range(4)] for i in range(2, 4)]
        columns = [[r[0] + dt * r[2], r[1] + dt * r[3], keep * r[2], keep * r[3]] for r in rows]
        for i in range(2):
            columns[i][i] += _K["DRIFT_VAR"] * dt
            columns[i + 2][i + 2] += (1.0 - keep * keep) * _K["SPEED_VAR"]
        self.covariance = columns
        self.height_var += _K["DRIFT_VAR"] * dt

    def _look(self, age_s: float, detections: list[RawDetection]) -> None:
        """Use an image: choose the likeliest detection, or count a miss."""
        then = next((one for one in reversed(self.past) if one.time_s >= self.image_s), self.pose)
        share = _K["SEEN_SHARE"] if self._is_in_view(then, age_s) else _K["UNSEEN_SHARE"]
        miss, total, others = 1.0 - share, 0.0, 0.0
        found = [self._weigh(then, one, age_s, share) for one in detections[:DETECTIONS_MAX]]
        for one in found:
            total += min(one.ratio, one.most_ratio)
            others += one.evidence
        likely = [one for one in found if one.ratio > miss]
        best = max(likely, key=lambda one: one.ratio, default=None)
        # The leader is at its place, or somewhere else in view or out of it.
        elsewhere = _K["ELSEWHERE_SHARE"] * (others - (best.evidence if best else 0.0)) / _K["VIEW"]
        elsewhere += 1.0 - _K["ELSEWHERE_SHARE"]
        self.odds = min(self.odds * (miss + total) / elsewhere, _K["MAX_ODDS"])
        self.odds = max(self.odds, 0.001)
        clear = [one for one in found if one.confidence >= _K["FOUND"]]
        clearest = max(clear, key=lambda one: one.confidence, default=None)
        if self.odds < _K["LOST_ODDS"] and clearest and clearest is not best:
            place = clearest.place
            self._restart(place.x, place.y, place.z, place.along, self.image_s)
        elif best:
            self._update(best, age_s, best.ratio / (miss + best.ratio))
            self.sure_s = self.image_s if best.confidence >= _K["SURE"] else self.sure_s

    def _weigh(self, then: _Pose, found: RawDetection, age_s: float, share: float) -> _Candidate:
        """Return how likely a detection is that of a leader seen in a share of images."""
        place = self._locate(then, found)
        residual = self._compare(place, age_s)
        square = place.odds * place.odds
        evidence = 1.0 / (1.0 / (_K["EVIDENCE"] * square) + 1.0 / _K["OTHERS"])
        ratio = share * evidence * residual.likelihood
        most_ratio = share * min(_K["STAYING"] + square, _K["OTHERS"])
        return _Candidate(found.confidence, place, residual, evidence, ratio, most_ratio)

    def _is_in_view(self, then: _Pose, age_s: float) -> bool:
        """Return whether the leader is expected in an image taken at a pose."""
        m = self.mean
        dx, dy = m[0] - age_s * m[2] - then.x, m[1] - age_s * m[3] - then.y
        ahead, aside = then.c * dx + then.s * dy, then.c * dy - then.s * dx
        return ahead > 0.1 and abs(aside) < _K["IN_VIEW"] * ahead

    def _locate(self, then: _Pose, found: RawDetection) -> _Place:
        """Return the place of a detection."""
        depth = found.depth_mm / 1000.0
        left = (self.camera.cx_px - found.u_q4 / 16.0) / self.camera.fx_px * depth
        up = (self.camera.cy_px - found.v_q4 / 16.0) / self.camera.fy_px * depth
        cr, sr = turn_of(then.roll)
        cp, sp = turn_of(then.pitch)
        level = sr * left + cr * up
        ahead, aside = cp * depth + sp * level, cr * left - sr * up
        x = then.x + (then.c * ahead - then.s * aside)
        y = then.y + (then.s * ahead + then.c * aside)
        z = then.height + (cp * level - sp * depth)
        away = root(ahead * ahead + aside * aside) + 0.001
        p = (found.confidence + 0.5) / 65536.0
        along, across = (_K["DEPTH_RATIO"] - _K["DEPTH_SURE"] * p) * away, _K["SIDE_RATIO"] * away
        to_x, to_y = (x - then.x) / away, (y - then.y) / away
        up = (z - then.height) / away * along
        variances = along * along, across * across, across * across + up * up
        return _Place(x, y, z, *variances, to_x, to_y, away, p / (1.0 - p))

    def _compare(self, place: _Place, age_s: float) -> _Residual:
        """Return the residual of a place."""
        x, y, z, along, across, upward, to_x, to_y, away, _ = place
        m, p = self.mean, self.covariance
        rx, ry = x - (m[0] - age_s * m[2]), y - (m[1] - age_s * m[3])
        aa = age_s * age_s
        sxx = p[0][0] - age_s * (p[0][2] + p[2][0]) + aa * p[2][2]
        sxy = p[0][1] - age_s * (p[0][3] + p[2][1]) + aa * p[2][3]
        syy = p[1][1] - age_s * (p[1][3] + p[3][1]) + aa * p[3][3]
        sxx += along * to_x * to_x + across * to_y * to_y
        sxy += (along - across) * to_x * to_y
        syy += along * to_y * to_y + across * to_x * to_x
        det = sxx * syy - sxy * sxy
        ixx, ixy, iyy = syy / det, -sxy / det, sxx / det
        rz, szz = z - self.height_m, self.height_var + upward
        squared = rx * (ixx * rx + ixy * ry) + ry * (ixy * rx + iyy * ry) + rz * rz / szz
        near = 1.0 + squared / 6.0  # a density with heavier tails than the Gaussian, without exp
        density = 1.0 / (15.749609945722419 * root(det * szz) * near * near * near)
        # False detections are as frequent in every direction and e-fold of distance.
        ratio = density * away * away * away
        return _Residual(rx, ry, ixx, ixy, iyy, 0.0 if squared > _K["GATE"] else ratio)

    def _update(self, found: _Candidate, age_s: float, weight: float) -> None:
        """Move by the residual, as far as the detection is probably the leader's."""
        place, residual, p = found.place, found.residual, self.covariance
        # Columns of the covariance of state and measurement, then the gain.
        hx = [p[i][0] - age_s * p[i][2] for i in range(4)]
        hy = [p[i][1] - age_s * p[i][3] for i in range(4)]
        kx = [weight * (hx[i] * residual.ixx + hy[i] * residual.ixy) for i in range(4)]
        ky = [weight * (hx[i] * residual.ixy + hy[i] * residual.iyy) for i in range(4)]
        self.mean = [self.mean[i] + (kx[i] * residual.x + ky[i] * residual.y) for i in range(4)]
        self.covariance = [
            [p[i][j] - (kx[i] * hx[j] + ky[i] * hy[j]) for j in range(4)] for i in range(4)
        ]
        kz = weight * self.height_var / (self.height_var + place.upward)
        self.height_m += kz * (place.z - self.height_m)
        self.height_var -= kz * self.height_var
        self.seen_s = self.image_s

    def _command(self, state: RobotState) -> tuple[float, float, float, float]:
        pose, m, p = self.pose, self.mean, self.covariance
        dx, dy = m[0] - pose.x, m[1] - pose.y
        x, y = pose.c * dx + pose.s * dy, pose.c * dy - pose.s * dx
        vx, vy = pose.c * m[2] + pose.s * m[3], pose.c * m[3] - pose.s * m[2]
        drift_x, drift_y = vx - state.vx_mps, vy - state.vy_mps
        stale = state.time_s - self.image_s > _K["STALE_S"]
        angle, blind_s = angle_of(x, y), state.time_s - self.seen_s
        # A false object keeps its apparent distance: who flies after it, or away, never stops.
        unsure = state.time_s - self.sure_s > _K["UNSURE_S"]
        away = root(x * x + y * y) + 0.001
        variance = 0.5 * (p[0][0] + p[1][1])
        if stale or unsure or blind_s > _K["BLIND_S"]:
            return (0.0, 0.0, 0.0, 0.0 if stale else self._search(angle, root(variance) / away))
        self.side = 1.0 if y + 0.7 * drift_y > 0.0 else -1.0
        to_x, to_y = x / away, y / away
        trust = self.odds / (1.0 + self.odds) / (1.0 + variance / _K["TRUST_VAR"])
        go_x, go_y = self.aim(x, y, away)
        wx, wy = trust * (vx + go_x), trust * (vy + go_y)
        if away < _K["NEAR"]:
            towards = wx * to_x + wy * to_y
            less = max(towards, 0.0) + 2.0 * trust * (_K["NEAR"] - away)
            wx, wy = wx - less * to_x, wy - less * to_y
        near = max(away * away, _K["NEAR"] * _K["NEAR"])
        turn = _K["TURN_GAIN"] * angle + trust * (x * drift_y - y * drift_x) / near
        climb = trust * _K["CLIMB_GAIN"] * (self.above_m + self.height_m - state.height_m)
        return (wx, wy, climb, turn)

    def _search(self, angle: float, deviation: float) -> float:
        """Return the turn of a search: from side to side, to show the likely directions."""
        if -self.side * angle > max(_K["SWEEP"] * deviation - _K["HALF_VIEW"], 0.0):
            self.side = -self.side
        return self.side * _K["SEARCH_RATE"]

    def aim(self, x: float, y: float, away: float) -> tuple[float, float]:
        """Return the velocity towards the wanted place, in the robot's horizontal frame.

        Parameters
        ----------
        x, y, away
            Place of the leader in that frame, and its distance.
        """
        short = _K["GAIN"] * (away - self.distance_m)
        return short * (x / away), short * (y / away)
