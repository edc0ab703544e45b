"""One distribution, the library and the nodes; to colcon it is the ament_python package mdf_nodes."""

from setuptools import setup

NAME = "mdf_nodes"

setup(
    name=NAME,
    version="0.1.0",
    description="Measures how a printed part is distorted and redesigns it so that the next print comes out right",
    license="Apache-2.0",
    maintainer="The mdf maintainers",
    maintainer_email="maintainers@example.org",
    packages=["mdf_core", "mdf_nodes"],
    # The patterns hold for either package, and match nothing where there is no such file.
    package_data={
        "": ["py.typed", "*.json", "*.xml", "*.yaml"],
        "mdf_core": ["migrations/*.py", "migrations/versions/*.py"],
    },
    # What ros2 run and ros2 launch look up; pip installs none of it.
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
    ],
    python_requires=">=3.10",
    # The same names as in requirements/run.in; rclpy and mdf_interfaces come from the ROS side.
    install_requires=[
        "alembic",
        "libigl",
        "lxml",
        "manifold3d",
        "matplotlib",
        "mcap",
        "mcap-ros2-support",
        "networkx",
        "numpy",
        "pypcd4",
        "PyYAML",
        "rich",
        "scipy",
        "sqlalchemy",
        "threadpoolctl",
        "trimesh>=5.2",
        "zstandard",
    ],
    entry_points={
        "console_scripts": [
            "mdf = mdf_core.cli:main",
            "scan_ingest = mdf_nodes.start:scan_ingest",
            "registration = mdf_nodes.start:registration",
            "compensation = mdf_nodes.start:compensation",
            "virtual_scanner = mdf_nodes.start:virtual_scanner",
            "bag_recorder = mdf_nodes.start:bag_recorder",
            "bag_player = mdf_nodes.start:bag_player",
            "cell = mdf_nodes.start:cell",
            "cell_demo = mdf_nodes.demo:main",
        ]
    },
    zip_safe=False,
)
