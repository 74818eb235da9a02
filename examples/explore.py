"""Read a recording into pandas, measure the error of UWB ranges, and save a file for rerun.

Run it in an empty folder: python explore.py
"""

from pathlib import Path

import numpy as np

import dmrl
from dmrl.viewer import Settings, save

flight = dmrl.fly("flight.mcap", robots=2, duration_s=20.0, noise="realistic", camera=True, seed=1)
print(flight)

# A topic is an array with a field for each column, or a data frame: to_pandas().
measured = flight["/cf1/range/cf2"].to_numpy()
truth = flight["/cf1/peer/cf2/truth"].to_numpy()
distance = np.sqrt(truth["x"] ** 2 + truth["y"] ** 2 + truth["z"] ** 2)
error_m = measured["range_m"] - np.interp(measured["log_time"], truth["log_time"], distance)
median_m, sigma_m = np.median(error_m), error_m.std()
print(f"{len(error_m)} ranges: median error {median_m:.3f} m, sigma {sigma_m:.3f} m")

# Images are decoded when they are used; labels have a row for each peer in view.
images, labels = flight.images("cf1"), flight.labels("cf1")
print(f"{len(images)} images of {images[0].shape}, {labels['peer'].count()} labels")

# The same as `dmrl view flight.mcap --save flight.rrd`; look at it with: rerun flight.rrd
print(f"flight.rrd: {save([flight.path], Path('flight.rrd'), Settings())} images")
