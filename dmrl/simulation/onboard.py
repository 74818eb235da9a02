"""What runs on a drone between its camera and its pilot: tracker, names and prediction."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from dmrl.estimation.tracking.detector_rates import DetectorRates
from dmrl.estimation.tracking.identity import TrackIdentity
from dmrl.estimation.tracking.tracker import Track, Tracker
from dmrl.estimation.tracking.tracker_input import EgoMotion, ImageDetections
from dmrl.estimation.tracking.tuning import Tuning
from dmrl.flight.dead_reckoning import DeadReckoning
from dmrl.flight.flight_arrays import RATE_HZ
from dmrl.flight.pilot import PeerTrack
from dmrl.geometry.frames import AIDECK_PINHOLE, yaw_matrix
from dmrl.labelling.peer_tracks import build_tracks
from dmrl.samples.sample import Sample

COLUMNS = ("u_px", "v_px", "depth_m", "sigma_depth_m", "confidence")


class OnboardTracker:
    """Tracker of one flown robot.

    Parameters
    ----------
    robot
        Its name.
    reckoning
        Its dead reckoning.
    """

    def __init__(self, robot: str, reckoning: DeadReckoning) -> None:
        self._robot, self._reckoning = robot, reckoning
        self._tracker: Tracker | None = None
        self._identity = TrackIdentity()
        self._sample: int | None = None
        self.detections: tuple[tuple[float, float, float, float], ...] = ()
        """u, v, depth and confidence of the detections of the last image."""
        self._tracks: list[Track] = []
        self._names: dict[int, str] = {}

    def see(
        self, sample: int, detections: Mapping[str, Any], range_m: dict[str, float]
    ) -> list[Track]:
        """Use the detections of an image, and return the reported tracks.

        Parameters
        ----------
        sample
            Sample at which the image was taken.
        detections
            Fields of the Detections.
        range_m
            Last range to each peer.
        """
        before = sample if self._sample is None else self._sample
        motion = EgoMotion(*self._reckoning.motion(before, sample))
        self._sample = sample
        roll, pitch = self._reckoning.sensors[:2, sample].tolist()
        rows = np.array([[d[name] for name in COLUMNS] for d in detections["detections"]])
        u, v, depth_m, sigma_m, confidence = rows.reshape(-1, len(COLUMNS)).T
        uv = np.column_stack([u, v])
        self.detections = tuple(
            zip(*(c.tolist() for c in (u, v, depth_m, confidence)), strict=True)
        )
        view = ImageDetections(uv, depth_m, roll, pitch, confidence, sigma_m)
        if self._tracker is None:
            rates = DetectorRates(**(detections.get("rates") or {}))
            self._tracker = Tracker(AIDECK_PINHOLE, Tuning(), rates)
        self._tracks = self._tracker.step(motion, view)
        self._names = self._identity.assign(self._tracks, range_m, motion.dt_s)
        return self._tracks

    def build_sample(self, time_ns: int, publish_ns: int) -> Sample:
        """Return the message of the tracks at the last image."""
        return build_tracks(self._robot, time_ns, self._tracks, self._names, publish_ns)

    def image_age_s(self, sample: int) -> float:
        """Return the time at a sample since the exposure of the last image; before it, infinity."""
        return float("inf") if self._sample is None else (sample - self._sample) / RATE_HZ

    def predict(self, sample: int) -> tuple[PeerTrack, ...]:
        """Return the tracks as they are at a sample after the last image."""
        if self._sample is None:
            return ()
        dt_s, shift_m, turn_rad = self._reckoning.motion(self._sample, sample)
        turn = yaw_matrix(turn_rad)
        found = []
        for track in self._tracks:
            moved = np.hstack([np.eye(3), dt_s * np.eye(3)])
            covariance = moved @ track.state_covariance @ moved.T
            place_m = track.position_m + dt_s * track.velocity_mps - shift_m
            turned = turn @ place_m, turn @ track.velocity_mps, turn @ covariance @ turn.T
            name, age_s = self._names.get(track.number, ""), dt_s + track.unseen_s
            found.append(PeerTrack(track.number, name, *turned, age_s))
        return tuple(found)
