"""Start the localizer: ros2 launch topoloc_ros localize.launch.py map:=office.topo"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Return the node with the parameters of config/topoloc.yaml and the arguments."""
    share = FindPackageShare("topoloc_ros")
    names = {
        "map": ("", "The map file."),
        "image": ("/camera/image_raw", "The topic of the images."),
        "use_sim_time": ("false", "Take the time from /clock."),
        "simulated": ("false", "The images are of a simulator without noise."),
        "autostart": ("true", "Configure and activate the node without a manager."),
    }
    arguments = [
        DeclareLaunchArgument(name, default_value=value, description=text)
        for name, (value, text) in names.items()
    ]
    params = DeclareLaunchArgument(
        "params", default_value=PathJoinSubstitution([share, "config", "topoloc.yaml"])
    )
    node = Node(
        package="topoloc_ros",
        executable="localizer",
        name="topoloc",
        output="screen",
        respawn=True,
        parameters=[
            LaunchConfiguration("params"),
            {name: LaunchConfiguration(name) for name in names},
        ],
    )
    return LaunchDescription([*arguments, params, node])
