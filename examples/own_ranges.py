"""Turn ranges and odometry in your own CSV files into positions of peers with their sigma.

Run it in an empty folder: python own_ranges.py
"""

import csv
from pathlib import Path

import numpy as np

import dmrl

# The logs of two robots over 60 s, as a lab's own logger may write them. Velocities are in the
# world frame, angles in degrees and ranges in millimetres, as the table of columns below states.
rng = np.random.default_rng(1)
time_s = np.arange(0.0, 60.0, 0.02)
paths = {
    "alpha": (np.sin(0.5 * time_s), 0.8 * np.cos(0.7 * time_s), 0.5 + 0 * time_s),
    "beta": (2.0 + np.cos(0.4 * time_s), np.sin(0.9 * time_s), 0.9 + 0 * time_s),
}
folder = Path("logs")
folder.mkdir()
for own, peer in (("alpha", "beta"), ("beta", "alpha")):
    x, y, z = paths[own]
    apart = np.sqrt(sum((a - b) ** 2 for a, b in zip(paths[own], paths[peer], strict=True)))
    velocity = [np.gradient(axis, time_s) + rng.normal(0, 0.05, len(time_s)) for axis in (x, y)]
    columns = {
        "t_ms": time_s * 1e3,
        "heading_deg": rng.normal(0, 0.01, len(time_s)),
        "vel_x": velocity[0],
        "vel_y": velocity[1],
        "alt_m": z + rng.normal(0, 0.01, len(time_s)),
        "roll": rng.normal(0, 0.5, len(time_s)),
        "pitch": rng.normal(0, 0.5, len(time_s)),
        "turn_dps": rng.normal(0, 0.3, len(time_s)),
        f"uwb_{peer}_mm": (apart + rng.normal(0, 0.05, len(time_s))) * 1e3,
    }
    with (folder / f"{own}.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow([name.replace(f"uwb_{peer}", "uwb_peer") for name in columns])
        writer.writerows(np.column_stack(list(columns.values())).tolist())

UNITS = """
time = { name = "t_ms", unit = "ms" }
roll = { name = "roll", unit = "deg" }
pitch = { name = "pitch", unit = "deg" }
yaw = { name = "heading_deg", unit = "deg" }
yaw_rate = { name = "turn_dps", unit = "deg/s" }
vx = { name = "vel_x", unit = "m/s", frame = "world" }
vy = { name = "vel_y", unit = "m/s", frame = "world" }
height = { name = "alt_m", unit = "m" }
"""
for own, peer in (("alpha", "beta"), ("beta", "alpha")):
    table = Path(f"{own}.toml")
    table.write_text(f'{UNITS}\n[range.{peer}]\nname = "uwb_peer_mm"\nunit = "mm"\n')
    dmrl.convert(folder / f"{own}.csv", f"{own}.mcap", columns=table, robot=own)

flight = dmrl.merge(["alpha.mcap", "beta.mcap"], "flight.mcap")
labelled = dmrl.label(flight, "labelled.mcap")
found = labelled["/alpha/peer/beta/position"].to_pandas()
true_x = np.interp(found.index, time_s, paths["beta"][0] - paths["alpha"][0])
true_y = np.interp(found.index, time_s, paths["beta"][1] - paths["alpha"][1])
error_m = np.hypot(found["x"] - true_x, found["y"] - true_y)
kept = found["status"] == "OK"
print(f"{len(found)} positions, {kept.mean():.0%} OK, median error {error_m[kept].median():.2f} m")
