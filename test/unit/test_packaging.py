"""setup.py, package.xml and the installed prefix agree; links of the documents are alive."""

import ast
import os
from pathlib import Path
import re
import runpy
import sys
import types
from typing import Any
import xml.etree.ElementTree as ElementTree

from harness import REPOSITORY
import pytest

from landmark_nav.storage import robot_files

MANIFEST = ElementTree.parse(REPOSITORY / 'package.xml').getroot()

# rosdep key -> what pip calls it. There is no key for mcap: rosdep users have it from pip, with
# its requirements.
DISTRIBUTIONS = {
    'python3-argcomplete': 'argcomplete',
    'python3-jinja2': 'jinja2',
    'python3-matplotlib': 'matplotlib',
    'python3-numpy': 'numpy',
    'python3-opencv': 'opencv-python-headless',
    'python3-rosbags-pip': 'rosbags',
    'python3-scipy': 'scipy',
    'python3-tqdm': 'tqdm',
    'python3-yaml': 'PyYAML',
}
# Come with the wheels that the extra `ros` names, or are not there as wheels (launch, tf2).
NOT_IN_EXTRA = {
    'ament_index_python',
    'builtin_interfaces',
    'launch',
    'launch_ros',
    'rcl_interfaces',
    'rosgraph_msgs',
    'std_msgs',
    'tf2_msgs',
}


@pytest.fixture(scope='module')
def setup_arguments():
    """What setup.py hands to setuptools."""
    given: dict[str, Any] = {}
    setuptools = types.ModuleType('setuptools')
    setuptools.setup = given.update
    setuptools.find_packages = lambda **_: []
    before = Path.cwd()
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, 'setuptools', setuptools)
        os.chdir(REPOSITORY)
        try:
            runpy.run_path('setup.py')
        finally:
            os.chdir(before)
    return given


def names(requirements):
    return {re.split(r'[\[=<>]', requirement)[0] for requirement in requirements}


def depends():
    return {str(element.text) for element in MANIFEST.iter('exec_depend')}


def test_name_version_and_licence_are_the_same_everywhere(setup_arguments):
    for field in ('name', 'version', 'license', 'description'):
        assert MANIFEST.findtext(field) == setup_arguments[field]
    changes = (REPOSITORY / 'CHANGELOG.rst').read_text(encoding='utf-8')
    assert re.search(rf'^{re.escape(setup_arguments["version"])} \(', changes, re.MULTILINE)
    assert 'Apache License' in (REPOSITORY / 'LICENSE').read_text(encoding='utf-8')


def test_python_dependencies_agree(setup_arguments):
    keys = {key for key in depends() if key.startswith('python3-')}
    assert {DISTRIBUTIONS[key] for key in keys} | {'mcap', 'lz4', 'zstandard'} == names(
        setup_arguments['install_requires']
    )


def test_every_third_party_import_is_declared(setup_arguments):
    modules = {'cv2': 'opencv-python-headless', 'yaml': 'PyYAML'}
    ros, python = set(), set()
    for path in (REPOSITORY / 'landmark_nav').rglob('*.py'):
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            found = []
            if isinstance(node, ast.Import):
                found = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                found = [str(node.module)]
            for name in (name.partition('.')[0] for name in found):
                if name in sys.stdlib_module_names or name == 'landmark_nav':
                    continue
                is_python = name in names(setup_arguments['install_requires']) or name in modules
                (python if is_python else ros).add(modules.get(name, name))
    assert python == names(setup_arguments['install_requires'])
    assert ros <= depends() | names(setup_arguments['extras_require']['batch'])


def test_the_extra_has_the_ros_dependencies(setup_arguments):
    ros = {key for key in depends() if not key.startswith('python3-')} - NOT_IN_EXTRA
    wheels = names(setup_arguments['extras_require']['ros'])
    assert {f'ros-{key.replace("_", "-")}' for key in ros} == wheels


def test_every_node_can_be_found_by_ros2_run(setup_arguments):
    files = dict(setup_arguments['data_files'])['lib/landmark_nav']
    scripts = setup_arguments['entry_points']['console_scripts']
    nodes = {script.partition(' = ')[0] for script in scripts if '.nodes.' in script}
    assert {Path(file).name for file in files} == nodes
    assert len(nodes) == 9
    for file in files:
        assert os.access(REPOSITORY / file, os.X_OK)


DOCS = REPOSITORY / 'docs'
PAGES = sorted(
    [
        *(path for path in DOCS.rglob('*.md') if '_build' not in path.parts),
        *REPOSITORY.glob('*.md'),
        *REPOSITORY.glob('bags/*.md'),
    ]
)
# Made at each build of the site.
GENERATED = DOCS / 'reference'
LINK = re.compile(r'\[[^]]*\]\(([^)\s]+)\)')


def anchors(page):
    """Anchors that its headings get, as in Sphinx and on the pages of hosts of code."""
    text = re.sub(r'```.*?```', '', page.read_text(encoding='utf-8'), flags=re.DOTALL)
    headings = re.findall(r'^#+ (.+)$', text, re.MULTILINE)
    plain = (re.sub(r'[^\w\- ]', '', heading.lower()) for heading in headings)
    return {heading.strip().replace(' ', '-') for heading in plain}


@pytest.mark.parametrize('page', PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_links_lead_to_files_and_headings(page):
    targets = LINK.findall(page.read_text(encoding='utf-8'))
    dead = []
    for target in targets:
        name, _, anchor = target.partition('#')
        file = (page.parent / name).resolve() if name else page
        if re.match(r'[a-z]+:', target) or file.is_relative_to(GENERATED):
            continue
        if not file.exists() or (anchor and anchor not in anchors(file)):
            dead.append(target)
    assert not dead


def test_every_page_of_the_site_is_in_its_index():
    listed = set(re.findall(r'^   (\S+)$', (DOCS / 'index.rst').read_text(), re.MULTILINE))
    pages = {
        str(path.relative_to(DOCS).with_suffix(''))
        for path in PAGES
        if path.is_relative_to(DOCS) and not path.is_relative_to(GENERATED)
    }
    assert pages <= listed


def test_all_fields_of_a_robot_file_are_described():
    text = (DOCS / 'files.md').read_text(encoding='utf-8')
    fields = {*robot_files.ROBOT_FIELDS, *robot_files._AXIS_FIELDS}
    assert {name for name in fields if name not in text} == set()
