"""Weigh detections, tracks and hypotheses: integrated probabilistic data association.

Existence and silence are states of a Markov chain (Markov chain two of Musicki, Evans and
Stankovic 1994). Each detection counts by its position and by the likelihood ratio of its confidence
(amplitude feature, Lerro and Bar-Shalom 1993). Of several tracks, each regards the detections of
the others as additional false alarms (linear multitarget IPDA, Musicki and La Scala 2008).
"""

from typing import NamedTuple

import numpy as np

from dmrl.estimation.tracking.track_states import FALSE_OBJECT, SEEN, SILENT
from dmrl.geometry.frames import Array

MAX_DIM_ODDS = 1.0
"""Largest odds that a detection is of a silent peer. A false object that stays near the peer fits
its track as well, however small the gate."""


class Association(NamedTuple):
    """Weights after an image.

    ``detection`` (T, N) and ``miss`` (T,) are the probabilities that each detection, and none of
    them, is of the track's object, given that there is one; ``belief`` (T, 4) is that of the
    hypotheses.
    """

    detection: Array
    miss: Array
    belief: Array


def associate(belief: Array, found: Array, near: Array, bright: Array) -> Association:
    """Weigh the detections of an image for every track.

    Parameters
    ----------
    belief
        (T, 4) probabilities of the hypotheses before the image.
    found
        (T, 4) probability of a detection under each of them, 0 for `NOBODY`.
    near
        (T, N) likelihood of each detection's place if it is of the track, over the density of
        false alarms; 0 outside the gate.
    bright
        (T, N) likelihood ratio of its confidence, peer to false alarm.
    """
    look = np.ones((len(near), 4, near.shape[1]))
    look[:, SEEN] = bright
    odds = np.maximum(found[:, SILENT, None] * near, 1e-12)
    look[:, SILENT] = np.minimum(1.0, MAX_DIM_ODDS / odds)
    weight = belief * found
    claim = np.einsum("ts,tsn->tn", weight, look) * near
    rest = belief * (1 - found)
    share = claim / (rest.sum(axis=1) + claim.sum(axis=1))[:, None]
    # Density of detections of the other tracks, over that of false alarms.
    density = claim / np.maximum(weight.sum(axis=1), 1e-12)[:, None]
    rival = density * share / (1 - share + 1e-9)
    near = near / (1 + rival.sum(axis=0) - rival)
    likelihood = found[:, :, None] * look * near[:, None]
    detection = np.einsum("ts,tsn->tn", belief, likelihood)
    miss = rest[:, FALSE_OBJECT:].sum(axis=1)
    total = miss + detection.sum(axis=1)
    after = belief * (1 - found + likelihood.sum(axis=2))
    return Association(
        detection / total[:, None], miss / total, after / after.sum(axis=1, keepdims=True)
    )
