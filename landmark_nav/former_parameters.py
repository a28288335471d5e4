"""
Parameters of the last release that were renamed, moved or removed; accepted for one release.

Names have a dot between sections, as in `parameters`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from landmark_nav.parameters import resembling

# Former name -> present name.
_RENAMED = {'command_type': 'command.type'}
# Former name -> key of `robot.yaml`. Other parameters of the section odometry have the same names
# there.
_OF_THE_ROBOT = {
    'joint_delay_s': 'joint_delay',
    'pan_min_rad': 'pan_min',
    'pan_max_rad': 'pan_max',
    'capture.pan_min_rad': 'pan_min',
    'capture.pan_max_rad': 'pan_max',
    'triplet.pan_rate_rad_s': 'pan_rate',
    'command.speed_rad_s': 'pan_rate',
    'triplet.pan_acceleration_rad_s2': 'pan_acceleration',
}
# Rows of section, module with its constants, and their names in release 0.1.0: they describe the
# method. The section of parameters without one is -; odometry.slip_sigma is replaced by
# slip_m_per_rad, which has another unit.
_CONSTANTS = """
- nodes image_rate_hz jpeg_quality command_timeout_s max_wait_s max_prior_age_s late_frames_s
- nodes start_sigma_m start_sigma_rad period_s deadband_rad start_delay_s clock
attention learning/attention weight_intensity weight_edges weight_vertical_edges weight_corners
attention learning/attention weight_symmetry weight_line_symmetry edge_low edge_high size_min_px
attention learning/attention size_max_px size_step_px least_response candidates_per_sector
attention learning/attention neighborhood_columns_px neighborhood_rows_px ambiguity_max noise_gray
stereo learning/stereo min_score max_second_ratio max_incidence_rad min_parallax_rad behind_wall_m
stereo learning/stereo before_wall_m margin_m
adjustment learning/adjustment azimuth_sigma_rad tangent_sigma hanging_sigma_m
adjustment learning/adjustment common_hanging_sigma_m
wall_fit learning/adjustment max_before_m max_behind_m max_turn_rad
election learning/election.py max_incidence_rad min_size_px max_overlap
reference_area learning/reference_area paper_sigma_m height_sigma_m horizon_sigma_rad edge_sigma_px
panorama learning/panorama blend crop_px px_per_rad
capture learning/capture arrival_tolerance_rad settled_velocity_rad_s
command ros/camera_frames.py min_duration_s
triplet localization/triplet bearing_sigma_rad min_sampling max_sampling min_range_m border_px
triplet localization/triplet margin_sigmas hysteresis views max_sigma_m
odometry localization/odometry slip_sigma
detection localization/detection min_size_px max_count enough max_second_ratio window_sigmas
detection localization/detection max_window_px vertical_sigma_px lens_sigma_px
triangulation localization/triangulation fit_probability max_sigma_m min_range_m
relocalization localization/relocalization min_landmarks max_sigma_m max_sigma_rad tilt_sigma_rad
world simulation robot_radius_m people
world.pan_tilt simulation max_rate_rad_s max_acceleration_rad_s2 pan_limit_rad tilt_limit_rad
world.pan_tilt simulation natural_frequency_hz damping_ratio encoder_step_rad
world.drive simulation max_speed_m_s max_turn_rad_s max_acceleration_m_s2
world.drive simulation max_turn_acceleration_rad_s2 track_m scale_sigma track_sigma slip_sigma_m
world.drive simulation encoder_step_m
world.camera simulation vignetting exposure auto_exposure target_brightness blur_sigma_px
world.camera simulation read_noise shot_noise
"""
# Former parameter -> module with the constant.
_MODULES = {
    f'{section}.{name}'.removeprefix('-.'): module
    for section, module, *names in map(str.split, _CONSTANTS.strip().splitlines())
    for name in names
}
# Former section of `--config`, whose subsections are sections now.
_UNWRAPPED = 'observation.'
# Greatest number of unknown names that are compared with known ones, which takes long.
_MOST_COMPARED = 20


@dataclass(frozen=True)
class Settled:
    """
    Given parameters by their present meaning: values by present names, and keys of `robot.yaml`.

    `warnings` about former names have a line each; `unknown` names have the suggestion of a known
    one, or ''.
    """

    values: dict[str, Any]
    robot: dict[str, Any]
    warnings: tuple[str, ...]
    unknown: dict[str, str]


def settled(given: Mapping[str, Any], known: Collection[str]) -> Settled:
    """Sort given values by their present meaning; `known` are all present names."""
    values: dict[str, Any] = {}
    robot: dict[str, Any] = {}
    unknown: dict[str, str] = {}
    renamed: dict[str, str] = {}
    moved: dict[str, str] = {}
    gone: dict[str, list[str]] = {}
    for name, value in given.items():
        bare = name.removeprefix(_UNWRAPPED)
        now = bare if bare in known else _RENAMED.get(bare, '')
        section, _, last = bare.rpartition('.')
        if now in known:
            if now != name:
                renamed[name] = now
            if now == name or now not in given:
                values[now] = value
        elif bare in _OF_THE_ROBOT:
            moved[bare] = _OF_THE_ROBOT[bare]
            robot[moved[bare]] = value
        elif where := _MODULES.get(bare):
            gone.setdefault(where, []).append(bare)
        elif section == 'odometry':
            moved[bare] = bare
            robot.setdefault(section, {})[last] = value
        else:
            unknown[name] = resembling(name, known) if len(unknown) < _MOST_COMPARED else ''
    return Settled(values, robot, tuple(_warnings(renamed, moved, robot, gone)), unknown)


def _warnings(
    renamed: Mapping[str, str],
    moved: Mapping[str, str],
    robot: Mapping[str, Any],
    gone: Mapping[str, list[str]],
) -> Iterator[str]:
    for name, now in renamed.items():
        yield f'parameter {name} is now called {now}: its old name ends with the next release'
    for key in dict.fromkeys(key.partition('.')[0] for key in moved.values()):
        names = [name for name, to in moved.items() if to.partition('.')[0] == key]
        value = robot[key]
        line = f'section {key}' if isinstance(value, Mapping) else f'{key}: {value}'
        yield (
            f'{_listed(names)} describes the robot: write it into robot.yaml ({line}), which goes '
            'before it; its name here ends with the next release'
        )
    for where, names in gone.items():
        yield (
            f'{_listed(names)} is ignored: it describes the method, not robot or room, and is a '
            f'constant in landmark_nav/{where}'
        )


def _listed(names: list[str]) -> str:
    """Text of the name of the first parameter, and of the number of others."""
    others = f' (and {len(names) - 1} more)' if len(names) > 1 else ''
    return f'parameter {names[0]}{others}'
