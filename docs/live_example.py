"""Blades and a cut that follow poses from a queue, as a tracker's thread would fill it: python docs/live_example.py"""

import queue
import threading
import time

import numpy as np

from data_synthetic import domains
from xfemnav import Session
from xfemnav.geometry.distmesh import distmesh
from xfemnav.geometry.sizing import SizeField

PLAN = np.array([[0.0, 75.0], [0.0, 30.0]])
HZ = 30


def track(poses: queue.Queue, seconds: float) -> None:
    """Stand in for a tracker: the blades open and shut once, while the cut's tip goes deeper."""
    for k in range(int(seconds * HZ)):
        phase = k / (seconds * HZ)
        poses.put(("blades", (3.0 * np.sin(np.pi * phase), 2.0 * np.sin(np.pi * phase))))
        if k % HZ == 0:
            poses.put(("tip", (0.0, 30.0 - 2.0 * phase)))
        time.sleep(1 / HZ)
    poses.put(None)


def main(seconds: float = 3.0) -> int:
    """Follow the poses until there are no more; the number of poses that were answered."""
    session = Session(distmesh(domains.disc(70.0), SizeField(5.0, 2.0, 12.0, (PLAN,))), corridor=PLAN)
    session.cut(PLAN)
    session.open(left=0.0, right=0.0)
    poses: queue.Queue = queue.Queue()
    threading.Thread(target=track, args=(poses, seconds), daemon=True).start()
    answered = 0
    while (pose := poses.get()) is not None:
        what, value = pose
        if what == "tip":
            session.cut([PLAN[0], value])
        else:
            session.open(left=value[0], right=value[1])
        gap = session.displacement([0.0, 60.0], "left") - session.displacement([0.0, 60.0], "right")
        answered += 1
        force = session.forces()["left"].mean_pressure_kPa
        print(f"{what:6s} lips {gap[0]:5.2f} mm apart, the left blade presses with {force:5.2f} kPa, "
              f"{poses.qsize()} poses wait")
    return answered


if __name__ == "__main__":
    main()
