"""Documents: links lead somewhere, fields of robot.yaml are described."""

from pathlib import Path
import re

import pytest

from landmark_nav.storage import setup_files

REPOSITORY = Path(__file__).resolve().parents[2]
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
    fields = {*setup_files._ROBOT_FIELDS, *setup_files._AXIS_FIELDS}
    assert {name for name in fields if name not in text} == set()
