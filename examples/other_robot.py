"""Label robots other than Crazyflies: two ground robots with UWB tags, one with a camera.

Any robot that logs its attitude, velocity, height and range to a peer can be labelled.
Run it in an empty folder: python other_robot.py
"""

import numpy as np

import dmrl
from dmrl.geometry.frames import Camera

rng = np.random.default_rng(2)
time_s = np.arange(0.0, 60.0, 0.02)
# Each robot drives its own path, with its yaw along its velocity.
paths = {
    "rover": np.stack([1.5 * np.sin(0.30 * time_s), 1.0 * np.sin(0.45 * time_s)]),
    "carrier": np.stack([3.0 + np.cos(0.35 * time_s), 1.2 * np.sin(0.25 * time_s)]),
}
with dmrl.writer("drive.mcap", robots="two ground robots") as out:
    for own, peer in (("rover", "carrier"), ("carrier", "rover")):
        velocity = np.gradient(paths[own], time_s, axis=1)
        yaw = np.unwrap(np.arctan2(velocity[1], velocity[0]))
        speed = np.hypot(velocity[0], velocity[1]) + rng.normal(0, 0.03, len(time_s))
        level = np.zeros(len(time_s))
        turn = np.gradient(yaw, time_s) + rng.normal(0, 0.01, len(time_s))
        attitude = {"roll_rad": level, "pitch_rad": level, "yaw_rate_radps": turn}
        out.write_columns(f"/{own}/attitude", time_s, attitude)
        out.write_columns(f"/{own}/velocity", time_s, {"vx_mps": speed, "vy_mps": level})
        out.write_columns(f"/{own}/height", time_s, {"height_m": level + 0.15})
        apart = np.linalg.norm(paths[own] - paths[peer], axis=0) + rng.normal(0, 0.05, len(time_s))
        out.write_columns(f"/{own}/range/{peer}", time_s, {"range_m": apart})
    out.camera("rover", Camera(320, 240, 200.0, 200.0, 160.0, 120.0))
    for moment in np.arange(5.0, 55.0, 1.0):
        out.image("rover", float(moment), rng.integers(0, 255, (240, 320, 3), np.uint8), quality=80)

labelled = dmrl.label("drive.mcap", "labelled.mcap")
position = labelled["/rover/peer/carrier/position"].to_pandas()
print(f"{(position['status'] == 'OK').mean():.0%} of {len(position)} positions are OK")
labels = labelled.labels("rover").dropna(subset=["u_px"])
print(f"{len(labels)} labels in images; the surest lies within {labels['sigma_u_px'].min():.1f} px")
