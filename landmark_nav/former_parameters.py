"""
Parameters of the last release that were renamed, moved or removed; accepted for one release.

Names have a dot between sections, as in `parameters`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from landmark_nav.parameters import resembling

# Former section -> present section; former name -> present name.
_MOVED = {'joint': 'estimator'}
_RENAMED = {
    'command_type': 'command.type',
    'estimator.lean_sigma_rad': 'estimator.floor_tilt_sigma_rad',
    'estimator.map_memory_m': 'estimator.correlation_length_m',
    'fusion.map_memory_m': 'estimator.correlation_length_m',
    'fusion.correlation_length_m': 'estimator.correlation_length_m',
}
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
# Rows of a section and names of parameters that are gone: they described the method. The section
# of parameters without one is -.
_GONE = """
- clock command_timeout_s deadband_rad gather_s image_rate_hz jpeg_quality late_frames_s
- max_prior_age_s max_wait_s pan_sigma_rad period_s start_delay_s start_sigma_m start_sigma_rad
- turned_sigma_rad wide_sigma_m wide_sigma_rad
adjustment azimuth_sigma_rad camera_weight common_hanging_sigma_m hanging_length_m hanging_sigma_m
adjustment nearness_sigma place_weight relief_sigma_m room_weight tangent_sigma wall_sigma_m
attention ambiguity_max bearing_sigma_max_px candidates_per_sector center_sigma_px edge_high
attention edge_low inhibition least_response neighborhood_columns_px neighborhood_rows_px
attention noise_gray sector_deg size_max_px size_min_px size_step_px surround_sigma_px
attention weight_corners weight_edges weight_intensity weight_line_symmetry weight_radial_symmetry
attention weight_symmetry weight_vertical_edges
calibration enabled significance worth_px
capture arrival_tolerance_rad least_sharpness moved_m moved_rad resume_s retake_pause_s retakes
capture settled_s settled_samples settled_velocity_rad_s stamp_gap_s
command min_duration_s
detection appearance enough lens_sigma_px max_count max_second_ratio max_window_px min_size_px
detection target_count vertical_sigma_px window_sigmas
election max_chi_square max_incidence_rad max_overlap max_stretch min_size_px threshold_share
estimator floor_tilt_length_m history_s lean_length_m mount_walk_rad_per_sqrt_s step_sigma_m
estimator step_sigma_rad step_sigma_s tail_freedom
fusion astray_limit_m astray_sigma_m astray_sigma_rad bearing_probability boresight_sigma_rad
fusion correlated_noise_fraction curvature_repeats delay_sigma_s history_s landmarks mode
fusion nonlinearity_inflation pan_sigma_rad pose_probability principal_point_sigma repeat_length_m
fusion repeated_share turn_sigma_rad
health coasting_after_s found_after_acceptances found_share lost_after_rejections lost_sigma_m
health lost_sigma_rad missing_expected missing_extent_m missing_s missing_share nis_correlation
health nis_probability nis_window silent_after_s trouble_s usable_share
look_around after_s dwell_time_s look_s lost_sigma_m lost_sigma_rad
odometry acceleration_m_s2 horizon_s learning_range learning_sigma learning_way_m slip_sigma
odometry turn_acceleration_rad_s2
panorama blend crop_px even_out px_per_rad
reference_area edge_sigma_px height_sigma_m horizon_sigma_rad pan_sigma_rad paper_sigma_m
reference_area paper_size_sigma
relocalization candidates lean_sigma_rad lost_sigma_m lost_sigma_rad max_drift_m max_drift_rad
relocalization max_frames max_rival_share max_sigma_m max_sigma_rad min_found_share min_landmarks
relocalization min_spread_rad pan_sigma_rad slip tilt_sigma_rad unseen_s
relocalization.detection appearance lens_sigma_px max_count max_second_ratio max_window_px
relocalization.detection min_size_px vertical_sigma_px window_sigmas
relocalization.hypothesis distinct_m distinct_rad fine_rad min_support per_landmark places
relocalization.hypothesis rough_rad
relocalization.sighting min_score min_size_px per_view resolution tangent_sigma
relocalization.triangulation danger_margin fit_probability max_sigma_m min_range_m
relocalization.triangulation start_probability
relocalization.visibility bearing_sigma_rad border_px hysteresis look_s margin_sigmas max_range_m
relocalization.visibility max_sampling max_sigma_m min_range_m min_sampling
relocalization.visibility pan_acceleration_rad_s2 pan_rate_rad_s views
stereo before_wall_m behind_wall_m margin_m max_incidence_rad max_return_px max_second_ratio
stereo min_approach min_parallax_rad min_scale_ratio min_score
triangulation danger_margin fit_probability max_sigma_m min_range_m start_probability
triplet bearing_sigma_rad border_px dwell_time_s fix_window_s gather_s hysteresis look_s
triplet margin_sigmas max_sampling max_sigma_m min_range_m min_sampling views
unmeasured camera_weight
unmeasured.facades max_facades max_gap_m min_cells min_length_m relief_m sigma_m wall_height_m
unmeasured.relative_pose direction_sigma_rad features heading_sigma_rad max_ratio max_rival
unmeasured.relative_pose min_baseline_m min_matches rise_sigma_m tilt_sigma_rad
unmeasured.sheets corner_sigma_px size_sigma
wall_fit max_before_m max_behind_m max_distance_m max_sigma_m max_spread_m max_turn_rad
wall_fit min_extent_m min_patches
world people robot_radius_m
world.camera auto_exposure blur_sigma_px exposure read_noise shot_noise target_brightness
world.camera vignetting
world.drive encoder_step_m max_acceleration_m_s2 max_speed_m_s max_turn_acceleration_rad_s2
world.drive max_turn_rad_s scale_sigma slip_sigma_m track_m track_sigma
world.pan_tilt damping_ratio encoder_step_rad max_acceleration_rad_s2 max_rate_rad_s
world.pan_tilt natural_frequency_hz pan_limit_rad tilt_limit_rad
"""
_IGNORED = {
    f'{section}.{name}'.removeprefix('-.')
    for section, *names in map(str.split, _GONE.strip().splitlines())
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
    gone: list[str] = []
    for name, value in given.items():
        bare = name.removeprefix(_UNWRAPPED)
        section, _, last = bare.rpartition('.')
        if section in _MOVED:
            bare = f'{_MOVED[section]}.{last}'
        now = bare if bare in known else _RENAMED.get(bare, '')
        if now in known:
            if now != name:
                renamed[name] = now
            if now == name or now not in given:
                values[now] = value
        elif bare in _OF_THE_ROBOT:
            moved[bare] = _OF_THE_ROBOT[bare]
            robot[moved[bare]] = value
        elif bare in _IGNORED:
            gone.append(bare)
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
    gone: list[str],
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
    if gone:
        yield f'{_listed(gone)} is ignored: it described the method and is no longer a parameter'


def _listed(names: list[str]) -> str:
    """Text of the name of the first parameter, and of the number of others."""
    others = f' (and {len(names) - 1} more)' if len(names) > 1 else ''
    return f'parameter {names[0]}{others}'
