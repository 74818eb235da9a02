"""Plot the state estimate of a Crazyflie and its motion capture.

python benchmarks/state_and_capture.py REC.mcap OUT.png [ROBOT]

REC.mcap comes from ``dmrl convert`` of a micro-SD log with the ``locSrv`` variables.
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from dmrl.geometry.rotations import quaternion_to_euler
from dmrl.recording import read_table

COLOURS = ("#c0392b", "#1e8449", "#2471a3")


def poses(recording: Path, topic: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times (N,), s, positions (N, 3), m, and roll, pitch, yaw (N, 3), degrees."""
    table = read_table(recording, topic)
    rows = table["pose"].to_pylist()
    place = np.array([[row["position"][n] for n in "xyz"] for row in rows])
    turn = np.array([[row["orientation"][n] for n in "xyzw"] for row in rows])
    angles = np.unwrap(quaternion_to_euler(turn), axis=0)
    return table["log_time"].to_numpy() * 1e-9, place, np.degrees(angles)


def main(recording: str, out: str, robot: str = "cf1") -> None:
    """Write the picture; print the median and largest distance."""
    time, state, angles = poses(Path(recording), f"/{robot}/pose")
    true_time, truth, true_angles = poses(Path(recording), f"/{robot}/pose/truth")
    start = time[0]
    velocity = read_table(Path(recording), f"/{robot}/velocity")
    at = np.stack([np.interp(true_time, time, axis) for axis in state.T], axis=1)
    apart = np.linalg.norm(at - truth, axis=1)

    figure = Figure((9, 8), layout="constrained")
    place, turn, speed = figure.subplots(3, 1, sharex=True)
    for k, (axis, angle) in enumerate(zip("xyz", ("roll", "pitch", "yaw"), strict=True)):
        place.plot(time - start, state[:, k], color=COLOURS[k], label=f"{axis}, state")
        place.plot(true_time - start, truth[:, k], "k:", lw=1.5)
        turn.plot(time - start, angles[:, k], color=COLOURS[k], label=f"{angle}, state")
        turn.plot(true_time - start, true_angles[:, k], "k:", lw=1.5)
    # Velocity from motion capture in the robot's horizontal frame, by central differences.
    window = 5
    kernel = np.ones(window) / window
    yaw = np.radians(true_angles[:, 2])
    smooth = np.stack([np.convolve(axis, kernel, "same") for axis in truth.T[:2]])
    vx, vy = np.gradient(smooth, true_time, axis=1)
    level = (np.cos(yaw) * vx + np.sin(yaw) * vy, np.cos(yaw) * vy - np.sin(yaw) * vx)
    inner = slice(window, -window)
    for k, name in enumerate(("vx_mps", "vy_mps")):
        own = velocity["log_time"].to_numpy() * 1e-9 - start
        speed.plot(
            own, velocity[name].to_numpy(), color=COLOURS[k], label=f"{name[:2]}, /{robot}/velocity"
        )
        speed.plot((true_time - start)[inner], level[k][inner], "k:", lw=1.5)
    for axes, label in ((place, "place, m"), (turn, "attitude, degrees"), (speed, "velocity, m/s")):
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
        axes.plot([], [], "k:", lw=1.5, label="motion capture")
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    speed.set_xlabel("time, s")
    middle, most = np.median(apart) * 1e3, apart.max() * 1e3
    what = f"state {middle:.1f} mm from motion capture (median), {most:.1f} mm at most"
    place.set_title(f"{Path(recording).stem}: {what}")
    figure.savefig(out, dpi=90, metadata={"Software": None})
    print(f"{out}: median {middle:.1f} mm, largest {most:.1f} mm, {len(apart)} poses")


if __name__ == "__main__":
    main(*sys.argv[1:])
