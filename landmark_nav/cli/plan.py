"""`landmark-nav plan`: propose positions of panoramas."""

from __future__ import annotations

import argparse

import numpy as np
import yaml

from landmark_nav.cli.options import add, progress, within, wrapped
from landmark_nav.errors import UsageError
from landmark_nav.evaluation.figures.map_figure import draw_plan
from landmark_nav.planning.planner import Plan, plan_positions
from landmark_nav.planning.prediction import CAP_M
from landmark_nav.planning.views import PlanConfig
from landmark_nav.storage.atomic_io import check_new, check_writable, write_atomically
from landmark_nav.storage.robot_files import load_calibration
from landmark_nav.storage.setup_files import load_room

_SCHEMA = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    default = PlanConfig()
    parser.description = (
        'Predict from the wall map, the papers and the camera how exactly a robot '
        'would know its place all over the floor, and propose the places for panoramas that make '
        'this error smallest. A PNG of the same name shows the expected accuracy. Furniture is '
        'not in the wall map: take the nearest free place.'
    )
    add(parser, '--room', required=True, help='room.yaml, measured or of learn --walls-out')
    add(parser, '--robot', required=True)
    several = {'type': within(int, 2, 100), 'metavar': 'N', 'help': 'how many places, 2 or more'}
    add(parser, '--positions', **several, required=True)
    add(parser, '--out', required=True, metavar='PLAN', help='plan.yaml to write')
    add(parser, '--overwrite')
    focal = {'type': within(float, 50, 20000), 'default': default.focal_px, 'metavar': 'PX'}
    add(parser, '--focal', **focal, help='focal length of the camera in pixels')
    size = {'nargs': 2, 'type': within(int, 16, 16384), 'metavar': ('W', 'H')}
    width, height = default.width_px, default.height_px
    text = f'of its images in pixels (default {width} {height})'
    add(parser, '--size', **size, default=(width, height), help=text)
    clearance = {'type': within(float, 0.05, 5), 'default': default.clearance_m, 'metavar': 'M'}
    add(parser, '--clearance', **clearance, help='least metres of the robot from walls')


def run(args: argparse.Namespace) -> int:
    """Plan positions, draw the figure, and write the plan."""
    check_writable(args.out)
    figure_path = args.out.with_suffix('.png')
    if args.out == figure_path:
        raise UsageError(
            f'--out {args.out}: the plan is YAML, and its image gets this name: take '
            f'{args.out.with_suffix(".yaml").name}'
        )
    check_new(args.overwrite, args.out, figure_path)
    check_writable(figure_path)
    room, known = load_room(args.room), load_calibration(args.robot)
    mount, tilt_rad = known.mount, known['camera_tilt'][0]
    (width, height), (low, high) = args.size, mount.pan_limits_rad
    seen = {'focal_px': args.focal, 'width_px': width, 'height_px': height}
    seen |= {'pan_min_rad': low, 'pan_max_rad': high, 'camera_tilt_rad': tilt_rad}
    config = PlanConfig(**seen, clearance_m=args.clearance)
    rng = np.random.default_rng(0)
    plan = plan_positions(room, mount, args.positions, config, rng, progress)
    draw_plan(plan, room, figure_path)
    write_atomically(args.out, _text(plan, config, room.frame_id))
    print(_summary(plan))
    print(f'{args.out}, {figure_path}')
    return 0


def _text(plan: Plan, config: PlanConfig, frame_id: str) -> str:
    """Return the text of ``plan.yaml``."""
    best = plan.best
    sigma = np.sqrt(np.diagonal(best.pose_covariance, axis1=1, axis2=2))
    document = {
        'schema': _SCHEMA,
        'frame_id': frame_id,
        'camera': {
            'focal_px': config.focal_px,
            'width': config.width_px,
            'height': config.height_px,
            'pan_rad': [_short(config.pan_min_rad), _short(config.pan_max_rad)],
        },
        'positions': [
            {'pose': np.round(pose, 4).tolist(), 'sigma': [float(f'{v:.2g}') for v in deviation]}
            for pose, deviation in zip(best.poses_map_base, sigma, strict=True)
        ],
        'predicted': {
            'landmarks': round(float(best.landmarks.sum())),
            'landmark_sigma_m': _short(best.landmark_sigma_m),
            'localization': {
                'mean_m': _short(best.cost_m),
                'median_m': _short(best.quantile_m(0.5)),
                'p95_m': _short(best.quantile_m(0.95)),
                'covered': round(float(np.isfinite(best.sigma_m).mean()), 4),
            },
        },
        'compared': {
            'random': {
                'sets': len(plan.random),
                'best_m': _short(plan.random[0].cost_m),
                'median_m': _short(plan.random[len(plan.random) // 2].cost_m),
            }
        },
    }
    comment = (
        '# poses of base_link: x, y [m], heading [rad], sigma as papers or panoramas give it;\n'
        f'# means are of localization errors over the floor, each {CAP_M:g} m at most\n'
    )
    return comment + yaml.safe_dump(document, sort_keys=False, default_flow_style=None)


def _summary(plan: Plan) -> str:
    """Summarise the proposed positions, their accuracy, and that of other positions."""
    best = plan.best
    lines = [
        f'place {k}: x {x:.2f} m, y {y:.2f} m, heading {np.degrees(heading):.0f} deg'
        for k, (x, y, heading) in enumerate(best.poses_map_base, 1)
    ]
    covered = float(np.isfinite(best.sigma_m).mean())
    lines += [
        f'predicted: {best.landmarks.sum():.0f} landmarks within '
        f'{1e3 * best.landmark_sigma_m:.1f} mm; localization error '
        f'{1e3 * best.quantile_m(0.5):.1f} mm median, '
        f'{1e3 * best.quantile_m(0.95):.1f} mm or less on 95 % of the floor, {covered:.0%} of it '
        'covered',
        f'mean over the floor: {1e3 * best.cost_m:.2f} mm',
    ]
    count = len(plan.random)
    for name, rank in ('median of', count // 2), (f'best of {count}', 0):
        cost_m = plan.random[rank].cost_m
        lines.append(
            f'  {name} random places: {1e3 * cost_m:.2f} mm, {cost_m / best.cost_m:.2f} times the '
            'error of the plan'
        )
    return wrapped(lines)


def _short(value: float) -> float:
    return round(float(value), 6)
