"""A recording in pandas: how far off UWB ranges are, and a file that rerun opens.

Run it in an empty folder: python explore.py
"""

from pathlib import Path

import numpy as np

import dmrl
from dmrl.viewer import Settings, save

flight = dmrl.fly("flight.mcap", robots=2, duration_s=20.0, noise="realistic", camera=True, seed=1)
print(flight)

# A topic is a data frame over seconds; joining two of them is pandas' own work.
measured = flight["/cf1/range/cf2"].to_pandas()["range_m"]
truth = flight["/cf1/peer/cf2/truth"].to_pandas()[["x", "y", "z"]]
distance = np.sqrt((truth**2).sum(axis=1))
error_m = measured - np.interp(measured.index, distance.index, distance)
print(f"{len(error_m)} ranges: median error {error_m.median():.3f} m, sigma {error_m.std():.3f} m")

# Images are decoded when they are used; labels have a row per peer in view.
images, labels = flight.images("cf1"), flight.labels("cf1")
print(f"{len(images)} images of {images[0].shape}, {labels['peer'].count()} labels")

# The same as `dmrl view flight.mcap --save flight.rrd`; look at it with: rerun flight.rrd
print(f"flight.rrd: {save([flight.path], Path('flight.rrd'), Settings())} images")
