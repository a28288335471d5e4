"""Install the package with pip or with colcon; both lay out the same prefix."""

from glob import glob

from setuptools import find_packages, setup

PACKAGE = 'landmark_nav'
NODES = (
    'sweep_capture',
    'panorama_synthesizer',
    'landmark_learner',
    'triplet_selector',
    'triangulation_localizer',
    'odometry_fusion',
    'room_simulator',
    'bag_player',
    'all_nodes',
)
# Whose layouts show the topics of the nodes.
VIEWERS = ('rviz', 'foxglove', 'plotjuggler')

setup(
    name=PACKAGE,
    version='0.1.0',
    description='Lets a wheeled robot with one turning camera learn its landmarks by itself',
    license='Apache-2.0',
    maintainer='landmark_nav maintainers',
    maintainer_email='maintainers@landmark-nav.example',
    python_requires='>=3.10',
    packages=find_packages(include=[PACKAGE, f'{PACKAGE}.*']),
    package_data={
        PACKAGE: ['py.typed'],
        f'{PACKAGE}.evaluation.report': ['page.html.j2', 'page.css', 'page.js'],
        f'{PACKAGE}.batch': ['page.html.j2'],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        (f'share/{PACKAGE}/config', sorted(glob('config/*.*'))),
        *((f'share/{PACKAGE}/{viewer}', glob(f'config/{viewer}/*')) for viewer in VIEWERS),
        (f'share/{PACKAGE}/launch', sorted(glob(f'{PACKAGE}/launch/*.launch.py'))),
        (f'lib/{PACKAGE}', [f'resource/executables/{name}' for name in NODES]),
    ],
    # test/oldest.txt holds the lower bounds; docs/architecture.md says what each is for.
    install_requires=[
        'numpy>=1.26.0',
        'scipy>=1.11.2',
        'opencv-python-headless>=4.6.0.66',
        'PyYAML>=6.0.1',
        'jinja2>=3.1.2',
        'rosbags>=0.11.6',
        'mcap>=1.0.0',
        'lz4>=4.0.2',
        'zstandard>=0.22.0',
        'matplotlib>=3.6.0',
        'tqdm>=4.66.0',
        'argcomplete>=3.1.4',
    ],
    extras_require={
        # ROS 2 as wheels, for machines without a ROS 2 of their own; std_msgs, rosgraph_msgs and
        # builtin_interfaces come with these.
        'ros': [
            'ros-rclpy[fastrtps]==9.1.2',
            'ros-diagnostic-msgs==5.5.1',
            'ros-geometry-msgs==5.5.1',
            'ros-nav-msgs==5.5.1',
            'ros-sensor-msgs==5.5.1',
            'ros-std-srvs==5.5.1',
            'ros-trajectory-msgs==5.5.1',
            'ros-visualization-msgs==5.5.1',
        ],
        # The site in docs/; furo for phones and dark mode.
        'docs': ['furo>=2025.7', 'myst-parser>=4.0', 'sphinx>=8.1'],
        # Many bags at once, on one machine or several; Parquet is what tables are kept in.
        'batch': ['distributed>=2024.5', 'pyarrow>=16.0'],
        # Linters are pinned: another version would format and complain differently.
        # evo is what others measure trajectories with: our errors must be the same.
        'dev': [
            'evo>=1.31',
            'hypothesis>=6.100',
            'mypy==2.4.1',
            'pytest>=8.0',
            'pytest-xdist>=3.8',
            'ruff==0.17.5',
            # Drives Chromium, in which the pages of reports are tested.
            'selenium>=4.20',
            'types-PyYAML',
            'types-tqdm',
        ],
    },
    entry_points={
        'console_scripts': [
            f'landmark-nav = {PACKAGE}.__main__:main',
            *(f'{name} = {PACKAGE}.nodes.{name}:main' for name in NODES),
        ],
    },
    zip_safe=False,
)
