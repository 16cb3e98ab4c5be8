"""The localizer as a lifecycle node of rclpy, for middlewares other than DDS and for launch files
with parameters. `topoloc follow --ros` does the same without ROS."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, State, TransitionCallbackReturn
from rclpy.task import Future

from topoloc import Localizer, TopolocError, Tracker, TrackerConfig
from topoloc.apps.cli.features_option import parse_camera
from topoloc.apps.robots.robot_localizer import RobotLocalizer
from topoloc.apps.robots.ros_images import RosImages
from topoloc_ros.node import RclpyNode
from topoloc_ros.parameters import OWN, robot_config, setting_names


class LocalizerNode(LifecycleNode):
    """Configured, it has opened the map. Active, it localizes each image and publishes. `failed` is
    done if it cannot go on."""

    def __init__(self) -> None:
        super().__init__("topoloc")
        defaults = {name: getattr(robot_config({}), name) for name in setting_names()}
        for name, value in (OWN | defaults).items():
            self.declare_parameter(name, value)
        self.failed = Future()
        self._localizer: Localizer | None = None
        self._camera_of_size: Any = None
        self._stop, self._thread = threading.Event(), threading.Thread()

    def on_configure(self, state: State) -> TransitionCallbackReturn:
        """Read the parameters and open the map."""
        return self._attempt(self._open)

    def on_activate(self, state: State) -> TransitionCallbackReturn:
        """Begin to localize."""
        return self._attempt(self._start)

    def on_deactivate(self, state: State) -> TransitionCallbackReturn:
        """Stop publishing. The next activation begins without a pose."""
        self.end()
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, state: State) -> TransitionCallbackReturn:
        """Close the map, so that parameters can be changed."""
        self.end()
        self._localizer = None
        return TransitionCallbackReturn.SUCCESS

    on_shutdown = on_error = on_cleanup

    def end(self) -> None:
        """End the thread that localizes, if there is one."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def _attempt(self, action: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            action()
        except TopolocError as error:
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def _parameter(self, name: str) -> Any:
        return self.get_parameter(name).value

    def _open(self) -> None:
        names = [*setting_names(), "use_sim_time"]
        self._config = robot_config({name: self._parameter(name) for name in names})
        self._localizer = Localizer(self._parameter("map"))
        camera = self._parameter("camera")
        self._camera_of_size = parse_camera(self._localizer, camera) if camera else None

    def _start(self) -> None:
        warn, self._stop = self.get_logger().warning, threading.Event()
        with ExitStack() as stack:
            topics, source = stack.enter_context(closing(RclpyNode(self))), self._parameter("image")
            images = RosImages(topics, f"ros:{source}", self._camera_of_size is not None, warn)
            config = TrackerConfig(simulated=self._parameter("simulated"))
            tracker = stack.enter_context(closing(Tracker(self._localizer, config)))
            robot = stack.enter_context(closing(RobotLocalizer(topics, self._config, images, warn)))
            arguments = (stack.pop_all(), images, tracker, robot)
        self._thread = threading.Thread(target=self._follow, args=arguments, daemon=True)
        self._thread.start()

    def _follow(
        self, stack: ExitStack, images: RosImages, tracker: Tracker, robot: RobotLocalizer
    ) -> None:
        try:
            with stack:
                for frame in images.frames(self._stop):
                    robot.localize(frame, tracker, self._camera_of_size)
        except TopolocError as error:
            self.get_logger().fatal(str(error))
        finally:
            if not self._stop.is_set():
                self.failed.set_result(None)


def main() -> None:
    """Run the node until it is told to end, or cannot go on."""
    rclpy.init()
    node = LocalizerNode()
    try:
        if node.get_parameter("autostart").value:
            steps = (node.trigger_configure, node.trigger_activate)
            if not all(step() == TransitionCallbackReturn.SUCCESS for step in steps):
                sys.exit(1)
        with suppress(ExternalShutdownException, KeyboardInterrupt):
            rclpy.spin_until_future_complete(node, node.failed)
        sys.exit(int(node.failed.done()))
    finally:
        node.end()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
