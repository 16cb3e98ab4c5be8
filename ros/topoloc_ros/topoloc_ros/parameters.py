"""Turn parameters of ROS into settings of topoloc, and positional arguments into fields of
messages. Needs no ROS."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

from topoloc import ConfigError
from topoloc.apps.robots.config import RobotConfig
from topoloc.plugin import with_setting

OWN = {
    "map": "",
    "image": "/camera/image_raw",
    "camera": "",
    "simulated": False,
    "autostart": True,
}
"""Parameters of the node itself, with their defaults: the map file, the topic of the images, the
calibration if there is no camera_info, whether a simulator without noise renders the images, and
whether the node configures and activates itself."""
_OF_ROS = ("domain", "namespace", "use_sim_time")  # which ROS gives each node itself


def setting_names() -> list[str]:
    """Return the names of the settings that are parameters."""
    return [one.name for one in fields(RobotConfig) if one.name not in _OF_ROS]


def robot_config(parameters: Mapping[str, Any]) -> RobotConfig:
    """Return the settings. Raises ConfigError: a parameter is none, or out of bounds. Its name is
    in the text."""
    config = RobotConfig(domain=0)
    for name, value in parameters.items():
        if name not in (*setting_names(), "use_sim_time"):
            raise ConfigError(f"parameter {name}: topoloc_ros has no such parameter")
        with ConfigError.at(f"parameter {name}"):
            config = with_setting(config, name, value)
    return config


def by_position(kind: Any) -> Callable[..., Any]:
    """Return a function that makes a message of its fields in order, as those of topoloc are made.
    Messages of rclpy take names only, and an octet as bytes."""
    types: dict[str, str] = kind.get_fields_and_field_types()

    def make(*values: Any) -> Any:
        named = dict(zip(types, values, strict=True))
        octets = {name: bytes([named[name]]) for name in types if types[name] == "octet"}
        return kind(**named | octets)

    return make
