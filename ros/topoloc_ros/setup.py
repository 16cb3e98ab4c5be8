"""Install the package for colcon."""

from glob import glob

from setuptools import setup

NAME = "topoloc_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *(
            (f"share/{NAME}/{folder}", glob(f"{folder}/*"))
            for folder in ("launch", "config", "rviz")
        ),
    ],
    install_requires=["setuptools", "topoloc"],
    entry_points={"console_scripts": [f"localizer = {NAME}.lifecycle_node:main"]},
)
