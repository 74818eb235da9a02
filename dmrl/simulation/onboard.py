"""What runs on a drone between its camera and its pilot: tracker, names and prediction."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from dmrl.estimation.tracking.identity import TrackIdentity
from dmrl.estimation.tracking.tracker import Track, Tracker
from dmrl.estimation.tracking.tracker_input import EgoMotion, ImageDetections
from dmrl.estimation.tracking.tuning import Tuning
from dmrl.flight.dead_reckoning import DeadReckoning
from dmrl.flight.flight_arrays import RATE_HZ
from dmrl.flight.pilot import PeerTrack
from dmrl.geometry.frames import AIDECK_PINHOLE
from dmrl.labelling.peer_tracks import build_tracks
from dmrl.samples.sample import Sample

COLUMNS = ("u_px", "v_px", "depth_m", "sigma_depth_m")


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
        self._tracker, self._identity = Tracker(AIDECK_PINHOLE, Tuning()), TrackIdentity()
        self._sample: int | None = None
        self._tracks: list[Track] = []
        self._names: dict[int, str] = {}
        self._seen: dict[int, tuple[float, int]] = {}
        """By track: its score, and the sample of the last image that raised it."""

    def see(
        self, sample: int, detections: Mapping[str, Any], range_m: dict[str, float]
    ) -> list[Track]:
        """Use the detections of an image, and return the confirmed tracks.

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
        least, every = detections["threshold"], detections["detections"]
        kept = [[d[name] for name in COLUMNS] for d in every if d["confidence"] >= least]
        rows = np.array(kept)
        u, v, depth_m, sigma_m = rows.reshape(-1, 4).T
        view = ImageDetections(np.column_stack([u, v]), depth_m, roll, pitch, sigma_m)
        self._tracks = self._tracker.step(motion, view)
        self._names = self._identity.assign(self._tracks, range_m, motion.dt_s)
        last = self._seen
        self._seen = {
            t.number: (t.score, sample)
            if t.number not in last or t.score > last[t.number][0]
            else (t.score, last[t.number][1])
            for t in self._tracker.tracks
        }
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
        c, s = np.cos(turn_rad), np.sin(turn_rad)
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        found = []
        for track in self._tracks:
            moved = np.hstack([np.eye(3), dt_s * np.eye(3)])
            covariance = moved @ track.filter.P[:6, :6] @ moved.T
            place_m = track.position_m + dt_s * track.velocity_mps - shift_m
            found.append(
                PeerTrack(
                    track.number,
                    self._names.get(track.number, ""),
                    turn @ place_m,
                    turn @ track.velocity_mps,
                    turn @ covariance @ turn.T,
                    dt_s + (self._sample - self._seen[track.number][1]) / RATE_HZ,
                )
            )
        return tuple(found)
