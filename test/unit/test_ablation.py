"""Rows of the ablation name what exists."""

from importlib import import_module

from ablation import DRIVING, LEARNING, SEARCHING
import pytest


@pytest.mark.parametrize(
    'target',
    [name for part in (LEARNING, DRIVING, SEARCHING) for row in part.values() for name in row],
)
def test_the_target_of_a_row_exists(target):
    module, name = target.split(':')
    kind, _, field = name.partition('.')
    owner = getattr(import_module(module), kind)
    assert not field or hasattr(owner(), field)
