"""Blades and a cut that follow poses from a queue, as a tracker's thread would fill it: python docs/live_example.py"""

import queue
import threading
import time

import numpy as np

from xfemnav import Session
from xfemnav.geometry.plane.distmesh import distmesh
from xfemnav.geometry.plane.sizing import SizeField

PLAN = np.array([[0.0, 75.0], [0.0, 30.0]])
HZ = 30
ANGLE = np.linspace(0, 2 * np.pi, 360, endpoint=False)
ORGAN = 70.0 * np.column_stack([np.cos(ANGLE), np.sin(ANGLE)])  # mm


def track(poses: queue.Queue, seconds: float) -> None:
    """Stand in for a tracker: the blades open and shut once, while the cut's tip goes deeper."""
    for k in range(int(seconds * HZ)):
        phase = k / (seconds * HZ)
        poses.put(("blades", (3.0 * np.sin(np.pi * phase), 2.0 * np.sin(np.pi * phase))))
        if k % HZ == 0:
            poses.put(("tip", (0.0, 30.0 - 2.0 * phase)))
        time.sleep(1 / HZ)
    poses.put(None)


def latest(poses: queue.Queue) -> dict:
    """The latest pose of each kind since the last call, waiting for one; none when the tracker has ended."""
    found = {}
    while not (found and poses.empty()):
        pose = poses.get()
        if pose is None:
            poses.put(None)  # for the next call
            break
        kind, value = pose
        found[kind] = value
    return found


def main(seconds: float = 3.0) -> int:
    """Follow the poses until there are no more; how often the session was asked."""
    session = Session(distmesh(ORGAN, SizeField(5.0, 2.0, 12.0, (PLAN,))), corridor=PLAN)
    session.cut(PLAN)
    session.open(left=0.0, right=0.0)
    poses: queue.Queue = queue.Queue()
    threading.Thread(target=track, args=(poses, seconds), daemon=True).start()
    answered = 0
    while found := latest(poses):
        if "tip" in found:
            session.cut([PLAN[0], found["tip"]])
        if "blades" in found:
            left, right = found["blades"]
            session.open(left=left, right=right)
        gap = session.displacement([0.0, 60.0], "left") - session.displacement([0.0, 60.0], "right")
        answered += 1
        force = session.forces()["left"].mean_pressure_kPa
        print(f"{' and '.join(found):14s} lips {gap[0]:5.2f} mm apart, the left blade presses with {force:5.2f} kPa, "
              f"{poses.qsize()} poses wait")
    return answered


if __name__ == "__main__":
    main()
