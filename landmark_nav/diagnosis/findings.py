"""Results of checks, one line each, for people and programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from landmark_nav.errors import one_line

Level = Literal['ok', 'warning', 'error']


@dataclass(frozen=True)
class Finding:
    """
    The result of one check; ``error`` if localization or learning cannot handle the fault.

    `measured` is for people, with units; `values` are the same for programs, with units in their
    names, such as ``offset_s``. `advice` is empty if the check passed. `when_read`: the readers of
    the bag report it as well, message by message.
    """

    name: str
    level: Level
    measured: str
    advice: str = ''
    values: dict[str, Any] = field(default_factory=dict)
    when_read: bool = False

    def __post_init__(self) -> None:
        """Make both texts one line: names in messages may hold any characters."""
        object.__setattr__(self, 'measured', one_line(self.measured))
        object.__setattr__(self, 'advice', one_line(self.advice))

    def line(self) -> str:
        """Return name, measurement and advice in one line."""
        return f'{self.name}: {self.measured}' + (f': {self.advice}' if self.advice else '')

    def report(self) -> dict[str, Any]:
        """Return the entry of ``check --json``."""
        return {k: v for k, v in vars(self).items() if k != 'when_read'}


@dataclass(frozen=True)
class Delays:
    """
    Delays of the stamps of streams, s, beyond those of ``robot.yaml``, that readers subtract.

    `pan_sigma_s` is the sigma of the delay between images and joints.
    """

    images_s: float = 0.0
    joints_s: float = 0.0
    odometry_s: float = 0.0
    pan_sigma_s: float = 0.0


@dataclass(frozen=True)
class Diagnosis:
    """Findings, and the delays that can be corrected."""

    findings: tuple[Finding, ...]
    delays: Delays = Delays()

    @property
    def errors(self) -> tuple[Finding, ...]:
        """Findings that prevent localization or learning."""
        return tuple(finding for finding in self.findings if finding.level == 'error')

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """Findings that reduce, or may reduce, the accuracy."""
        return tuple(finding for finding in self.findings if finding.level == 'warning')

    @property
    def status(self) -> Level:
        """Level of the worst finding."""
        return 'error' if self.errors else 'warning' if self.warnings else 'ok'


def table(findings: Sequence[Finding]) -> list[str]:
    """Aligned lines: name, level and measurement; the advice is on a line below."""
    width = max((len(finding.name) for finding in findings), default=0)
    lines = []
    for finding in findings:
        lines.append(f'{finding.name:{width}}  {finding.level:7}  {finding.measured}')
        if finding.advice:
            lines.append(f'{"":{width}}           {finding.advice}')
    return lines
