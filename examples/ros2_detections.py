"""Write detections of a network to a ROS 2 bag, and read it with rosbags, which needs no ROS.

Needs ``pip install 'dmrl[ros]'``. Run it in an empty folder: python ros2_detections.py
"""

from pathlib import Path

from rosbags.highlevel import AnyReader

import dmrl
from dmrl.stages import convert

dmrl.sketch("pictures", images=12, seed=1)
pictures = dmrl.convert("pictures", "pictures.mcap")
found = dmrl.predict("dmrl-nano", pictures, "found.mcap")
convert.run(found.path, Path("bag"), convert.Settings(to="ros2"))

with AnyReader([Path("bag")]) as reader:
    for connection in reader.connections:
        print(connection.topic, connection.msgtype, connection.msgcount)
