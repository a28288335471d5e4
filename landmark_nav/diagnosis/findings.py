"""What a check found: one line each, for people and programs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from landmark_nav.errors import one_line

Level = Literal['ok', 'warning', 'error']

_ORDER: tuple[Level, ...] = ('ok', 'warning', 'error')


@dataclass(frozen=True)
class Finding:
    """
    The result of one check.

    Parameters
    ----------
    name : str
        What was checked: ``odom clock``.
    level : Level
        An error is what localization or learning cannot handle.
    measured : str
        What was measured, with its unit, for people.
    advice : str
        What to do; empty where all is well.
    values : dict
        The same as `measured` for programs; the unit is in the name: ``offset_s``.
    when_read : bool
        Whether whoever reads the bag says it as well, message by message.
    """

    name: str
    level: Level
    measured: str
    advice: str = ''
    values: dict[str, Any] = field(default_factory=dict)
    when_read: bool = False

    def __post_init__(self) -> None:
        """Names in messages may hold anything."""
        object.__setattr__(self, 'measured', one_line(self.measured))
        object.__setattr__(self, 'advice', one_line(self.advice))

    def line(self) -> str:
        """All of it in one line."""
        return f'{self.name}: {self.measured}' + (f': {self.advice}' if self.advice else '')

    def report(self) -> dict[str, Any]:
        """Entry of ``check --json``."""
        return {
            'name': self.name,
            'level': self.level,
            'measured': self.measured,
            'advice': self.advice,
            'values': self.values,
        }


@dataclass(frozen=True)
class Delays:
    """
    By how much streams are stamped late, seconds, where that is to be taken off.

    `pan_sigma_s` is the sigma of what the first two do to the pan of an image.
    """

    images_s: float = 0.0
    joints_s: float = 0.0
    odometry_s: float = 0.0
    pan_sigma_s: float = 0.0


@dataclass(frozen=True)
class Diagnosis:
    """What was found, and the delays that can be corrected."""

    findings: tuple[Finding, ...]
    delays: Delays = Delays()

    @property
    def errors(self) -> tuple[Finding, ...]:
        """What cannot be localized or learned with."""
        return tuple(finding for finding in self.findings if finding.level == 'error')

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """What costs accuracy, or may."""
        return tuple(finding for finding in self.findings if finding.level == 'warning')


def worst(findings: Iterable[Finding]) -> Level:
    """Level of the worst finding."""
    return max((finding.level for finding in findings), key=_ORDER.index, default='ok')


def table(findings: Sequence[Finding]) -> list[str]:
    """Aligned lines: name, level, what was measured; what to do below it."""
    width = max((len(finding.name) for finding in findings), default=0)
    lines = []
    for finding in findings:
        lines.append(f'{finding.name:{width}}  {finding.level:7}  {finding.measured}')
        if finding.advice:
            lines.append(f'{"":{width}}           {finding.advice}')
    return lines
