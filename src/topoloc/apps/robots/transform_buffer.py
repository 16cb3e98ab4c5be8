"""Buffer the transforms of /tf and /tf_static, and look them up at a time.

In the tree of TF each frame has one parent. A transform between two times is interpolated. Nothing
is extrapolated.
"""

from __future__ import annotations

import bisect
import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass, field

from topoloc import Rigid3, TopolocError
from topoloc.apps.formats.bags.bag_poses import pose_of_transform
from topoloc.apps.formats.bags.messages import StampedTransform


class TransformError(TopolocError):
    """Report transforms that are missing, or that loop."""


@dataclass(eq=False)
class _Edge:
    """Hold the transforms of a frame in its parent, in order of time."""

    parent: str
    is_static: bool
    t_ns: list[int] = field(default_factory=list)
    poses: list[Rigid3] = field(default_factory=list)

    def add(self, t_ns: int, pose: Rigid3) -> None:
        seconds = 10.0  # transforms are kept for so long
        if self.is_static or (self.t_ns and t_ns < self.t_ns[-1] - seconds * 1e9):
            self.t_ns, self.poses = [], []  # the newest one holds, or the clock was set back
        at = bisect.bisect_left(self.t_ns, t_ns)
        if self.t_ns[at : at + 1] != [t_ns]:
            self.t_ns.insert(at, t_ns)
            self.poses.insert(at, pose)
        old = bisect.bisect_left(self.t_ns, self.t_ns[-1] - int(seconds * 1e9))
        del self.t_ns[:old], self.poses[:old]

    def pose_at(self, t_ns: int) -> Rigid3 | None:
        """Return parent_from_child at a time, None if it is not between two known ones."""
        if self.is_static:
            return self.poses[-1]
        at = bisect.bisect_left(self.t_ns, t_ns)
        if at == len(self.t_ns):
            return None
        if self.t_ns[at] == t_ns:
            return self.poses[at]
        if at == 0:
            return None
        before, after = self.t_ns[at - 1 : at + 1]
        return self.poses[at - 1].interpolate(self.poses[at], (t_ns - before) / (after - before))


class TransformBuffer:
    """Hold the transforms of the last seconds. A thread may add some while another waits."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}
        self._changed = threading.Condition()

    def add(self, transforms: Iterable[StampedTransform], is_static: bool) -> None:
        """Add transforms. A frame that gets another parent forgets the one before."""
        with self._changed:
            for one in transforms:
                edge = self._edges.get(one.child)
                if edge is None or (edge.parent, edge.is_static) != (one.parent, is_static):
                    edge = self._edges[one.child] = _Edge(one.parent, is_static)
                edge.add(one.t_ns, pose_of_transform(one))
            self._changed.notify_all()

    def forget_after(self, t_ns: int) -> None:
        """Forget later transforms, because the clock was set back to this time."""
        with self._changed:
            for edge in self._edges.values():
                if not edge.is_static:
                    end = bisect.bisect_right(edge.t_ns, t_ns)
                    del edge.t_ns[end:], edge.poses[end:]

    def look_up(self, target: str, source: str, t_ns: int, wait_s: float = 0.0) -> Rigid3:
        """Return target_from_source at a time. Wait up to `wait_s` for its transforms. Raises
        TransformError: they are missing then, or TF has a loop."""
        end = time.monotonic() + wait_s
        with self._changed:
            while True:
                try:
                    return self._look_up(target, source, t_ns)
                except TransformError:
                    left = end - time.monotonic()
                    if left <= 0.0:
                        raise
                self._changed.wait(left)

    def _look_up(self, target: str, source: str, t_ns: int) -> Rigid3:
        paths = [self._path_to_root(end) for end in (target, source)]
        common = next((name for name in paths[0] if name in paths[1]), None)
        if common is None:
            raise TransformError(self._describe_gap(target, source))
        common_from_target, common_from_source = (
            self._compose(path[: path.index(common)], t_ns) for path in paths
        )
        return common_from_target.inverse() @ common_from_source

    def _path_to_root(self, frame: str) -> list[str]:
        path = [frame]
        while (edge := self._edges.get(path[-1])) is not None:
            if edge.parent in path:
                loop = [*path[path.index(edge.parent) :], edge.parent]
                raise TransformError(
                    f"TF loops: {' in '.join(loop)}; stop the node that publishes one of these"
                )
            path.append(edge.parent)
        return path

    def _compose(self, frames: list[str], t_ns: int) -> Rigid3:
        pose = Rigid3.identity()
        for child in frames:
            edge = self._edges[child]
            step = edge.pose_at(t_ns)
            if step is None:
                age = (t_ns - edge.t_ns[-1]) / 1e9 if edge.t_ns else 0.0
                span = f"the newest is {age:.2f} s older" if age > 0 else "all are newer"
                raise TransformError(
                    f"no transform from {edge.parent} to {child} at the time of the image,"
                    f" {span}; check its publisher and the clocks"
                )
            pose = step @ pose
        return pose

    def _describe_gap(self, target: str, source: str) -> str:
        children = set(self._edges)
        known = children | {edge.parent for edge in self._edges.values()}
        for frame in (source, target):
            if frame not in known:
                has = f"; TF has {', '.join(sorted(known)[:8])}" if known else "; TF is empty"
                return (
                    f"no frame {frame} in TF{has}; name the frames (--base-frame, --odom,"
                    " --camera-frame), or give --odom none"
                )
        return f"TF does not connect {target} to {source}; start the node that publishes the rest"
