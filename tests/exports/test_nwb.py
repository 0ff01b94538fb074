"""A session as NWB, read by pynwb: times, pose and flow are those of the session."""

from pathlib import Path

import numpy as np

import flowrec

GOLDEN = Path(__file__).parents[2] / "sessions" / "golden.mcap"


def test_images_pose_coils_and_flow_are_those_of_the_session_with_units(tmp_path):
    import pynwb  # most of a second: not in each worker

    session = flowrec.open(GOLDEN)
    path = flowrec.export(GOLDEN, tmp_path / "x.nwb", file_format="nwb")
    with pynwb.NWBHDF5IO(str(path), "r") as io:
        file = io.read()
        assert file.session_start_time.isoformat() == session.provenance["wall_time"]
        times = file.acquisition["camera_image_times"]
        assert (np.rint(1e9 * times.timestamps[:]) == session.reader.frame_stamps).all()
        assert (times.indexed_images.order_of_images[40].data[:] == session.frames[40].image).all()
        pose = file.processing["behavior"]["PoseEstimation"]["centre"]
        expected = [each.position_um for each in session.messages("estimate")]
        np.testing.assert_allclose(1e6 * pose.data[:], expected)
        assert file.stimulus["field_frequency"].unit == "hertz"
        flow = file.analysis["refined_flow"].to_dataframe()
        velocity = session.fields["refined"].velocity_um_s[session.chip.mask]
        np.testing.assert_array_equal(flow[["velocity_x_um_s", "velocity_y_um_s"]], velocity)
