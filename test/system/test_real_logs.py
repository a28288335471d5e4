"""A real robot's log, bearings alone: UTIAS MR.CLAM set 6, robot 3."""

from mrclam import driven, meets_bounds


def test_bearings_keep_commanded_odometry_on_the_floor(shared_data, tmp_path):
    report = driven(3, shared_data / 'mrclam', tmp_path)
    assert meets_bounds(report, 3)
    assert report['odometry']['position_rmse_m'] > 5.0 * report['fused']['position_rmse_m']
