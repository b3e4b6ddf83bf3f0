"""Sections of the list of hard cases, and the tests that have no measured error in ``docs/reference/stability.md``.

A plain string says why there is no test. A test holds that what is named here exists.
"""

from __future__ import annotations

SECTIONS: dict[str, range] = {
    "Geometry": range(1, 11),
    "Compositing": range(11, 17),
    "Losses and metrics": range(17, 22),
    "Time, poses, actors": range(22, 27),
    "Learned optimiser (GNet, ENet)": range(27, 33),
    "Fixer (FNet)": range(33, 38),
    "Storage and flow": range(38, 45),
    "A log as the world delivers it": range(45, 50),
    "Effects": range(50, 55),
}

_POSES = "tests/hard_cases/test_time_poses_actors.py"
_LOGS = "tests/hard_cases/test_logs_as_delivered.py"
_EFFECTS = "tests/hard_cases/test_effects.py"
_LOSS = "tests/losses/test_rendering_loss.py"
_SSIM = "tests/losses/test_ssim.py"
_UNROLL = "tests/optimiser/test_unroll.py"
_SPARSE = "tests/learned/test_sparse_conv.py"
_WEIGHTS = "tests/learned/test_weights.py"
_IMAGE = "tests/metrics/test_image_quality.py"
_DISTRIBUTION = "tests/metrics/test_distribution_distances.py"
_PERCEPTUAL = "tests/metrics/test_perceptual.py"
_NETWORK = "tests/fixer/test_fixer_network.py"
_SHIPPED = "tests/fixer/test_fnet_weights.py"
_FNET = "tests/fixer/test_fnet_stage.py"
_PRODUCE = "tests/flows/test_stage_runner.py"
_LOCAL = "tests/storage/test_local_store.py"

LISTED: dict[int, tuple[str, tuple[str, ...] | str]] = {
    17: (
        "empty mask, no valid LiDAR, zero or NaN depth",
        (
            f"{_IMAGE}::test_mask_leaves_out_what_it_should",
            f"{_LOSS}::test_no_valid_lidar_is_no_depth_loss",
            f"{_LOSS}::test_depth_loss_where_nothing_is_rendered_is_finite",
        ),
    ),
    18: (
        "SSIM of constant images",
        (
            f"{_SSIM}::test_constant_images_are_finite",
            f"{_SSIM}::test_identical_images_score_one_with_no_gradient",
            f"{_IMAGE}::test_constant_images",
        ),
    ),
    19: (
        "perceptual loss on crops smaller than its stride",
        (
            f"{_PERCEPTUAL}::test_constant_and_small_images_stay_finite",
            f"{_LOSS}::test_constant_images_and_small_crops_are_finite",
        ),
    ),
    20: ("PSNR of identical images", (f"{_IMAGE}::test_identical_images",)),
    21: (
        "Fréchet distance with N = 1, N below the feature dimension, identical sets",
        (
            f"{_DISTRIBUTION}::test_one_image_has_no_distance",
            f"{_DISTRIBUTION}::test_frechet_of_degenerate_sets",
            f"{_DISTRIBUTION}::test_frechet_of_identical_sets_is_zero",
        ),
    ),
    22: (
        "duplicated, unordered, microsecond timestamps",
        (
            f"{_POSES}::test_standstill_and_odd_timestamps",
            f"{_POSES}::test_microseconds_survive",
            "tests/logs/test_pandaset_reading.py",
            "tests/log_checks/test_check_log.py",
        ),
    ),
    23: (
        "slerp of parallel and antiparallel rotations",
        (f"{_POSES}::test_interpolation_is_the_shortest_turn",),
    ),
    24: (
        "pose asked for past the end of a track",
        (f"{_POSES}::test_poses_between_annotations_and_past_the_end", f"{_POSES}::test_actor_absent_past_its_track"),
    ),
    25: (
        "an actor seen in one frame, with few points, outside the chunk, with a NaN box",
        (f"{_POSES}::test_cuboids_that_are_unfit",),
    ),
    26: (
        "an actor at 180°, or overlapping the background",
        (
            f"{_POSES}::test_actor_at_any_yaw_also_a_half_turn",
            f"{_POSES}::test_an_actor_inside_the_background_renders_finite",
        ),
    ),
    27: (
        "gradients spanning 1e-12 … 1e8",
        (
            f"{_UNROLL}::test_gradients_of_many_sizes_at_once_give_finite_bounded_features",
            f"{_UNROLL}::test_the_step_does_not_depend_on_the_size_of_the_loss",
        ),
    ),
    28: (
        "a Gaussian that no view has seen gets exactly no update",
        (f"{_UNROLL}::test_a_gaussian_that_no_view_has_seen_gets_exactly_no_update",),
    ),
    29: (
        "permuted Gaussians permute the result; a shift by whole voxels changes nothing",
        (
            f"{_UNROLL}::test_permuting_the_gaussians_permutes_the_step",
            f"{_UNROLL}::test_shifting_everything_by_whole_voxels_changes_nothing",
            f"{_SPARSE}::test_unet_follows_a_permutation_of_the_points",
            f"{_SPARSE}::test_unet_is_unmoved_by_a_shift_of_whole_coarse_voxels",
        ),
    ),
    30: (
        "unrolled to ten times its T it stays bounded",
        (
            f"{_UNROLL}::test_far_beyond_its_horizon_it_stays_bounded",
            f"{_UNROLL}::test_no_side_grows_beyond_eight_times_the_longest_one_at_the_start",
            "tests/stages/test_gnet_enet.py::test_the_shipped_weights_stay_stable_at_ten_times_their_horizon",
        ),
    ),
    31: (
        "empty, single-voxel and all-in-one-voxel inputs",
        (
            f"{_UNROLL}::test_empty_and_single_scenes",
            f"{_UNROLL}::test_all_gaussians_in_one_voxel",
            f"{_SPARSE}::test_unet_on_degenerate_inputs",
        ),
    ),
    32: (
        "weights of another dtype or shape, with missing or extra keys (read onto the CPU, whatever the device)",
        (
            f"{_WEIGHTS}::test_tensors_that_do_not_fit_are_named",
            f"{_WEIGHTS}::test_weights_of_another_configuration_are_refused",
            f"{_FNET}::test_weights_that_do_not_fit_are_named",
        ),
    ),
    33: (
        "saturated and black images, in half precision too",
        (
            f"{_NETWORK}::test_black_and_saturated_images_stay_finite",
            f"{_SHIPPED}::test_black_and_saturated_images_stay_as_they_are",
            f"{_SHIPPED}::test_half_precision_changes_less_than_a_grey_level",
        ),
    ),
    34: (
        "sizes that are no multiple of the latent stride",
        (
            f"{_NETWORK}::test_any_size_comes_back_at_its_size",
            f"{_NETWORK}::test_sizes_that_do_not_fit_the_stride_are_refused",
            f"{_NETWORK}::test_large_images_are_fixed_in_tiles",
        ),
    ),
    35: ("a clean input comes back almost unchanged", (f"{_SHIPPED}::test_a_true_image_comes_back",)),
    36: (
        "a fixed seed gives the same image",
        (
            f"{_NETWORK}::test_a_seed_gives_one_image_and_another_seed_another",
            f"{_FNET}::test_the_seed_is_the_configurations",
        ),
    ),
    37: (
        "no global colour shift beyond a bound",
        ("tests/fixer/test_fixer_conditioning.py::test_colour_shift_is_brought_back_to_the_bound",),
    ),
    38: (
        "kill −9 at random times and inside each stage's commit, then resume",
        ("tests/faults/test_kill_resume.py", "tests/faults/test_store_kill.py"),
    ),
    39: (
        "two workers on one key",
        (
            "tests/faults/test_interruptions.py",
            f"{_LOCAL}::test_two_processes_on_one_key",
            "tests/contracts/store_suite.py",
        ),
    ),
    40: (
        "truncated and bit-flipped Parquet and EXR",
        ("tests/faults/test_store_corruption.py", f"{_PRODUCE}::test_a_damaged_file_is_found_named_and_computed_again"),
    ),
    41: (
        "EXR half overflow (depth is float32)",
        ("tests/storage/test_srgb.py::test_non_finite_and_overflow_are_named",),
    ),
    42: ("a moved store", (f"{_LOCAL}::test_a_moved_store_works", _PRODUCE)),
    43: (
        "out of memory: retried smaller",
        (_PRODUCE, "tests/flows/test_reconstruct.py::test_what_a_retry_can_cure_is_retried"),
    ),
    44: (
        "a miss on any change of configuration, input, weights or code; a hit on an unrelated one",
        (_PRODUCE, "tests/storage/test_code_digest.py"),
    ),
    45: (
        "a missing or unreadable sweep or image, a short last chunk",
        (
            f"{_LOGS}::test_a_hole_is_marked_and_the_run_goes_on",
            f"{_LOGS}::test_a_short_last_chunk",
            "tests/stages/test_ingest.py",
        ),
    ),
    46: (
        "no cuboids, one camera; no LiDAR at all",
        (
            f"{_LOGS}::test_no_cuboids_and_one_camera",
            f"{_LOGS}::test_no_lidar_at_all_asks_for_points_and_goes_on_with_them",
            "tests/stages/test_ingest.py",
        ),
    ),
    47: (
        "an ego vehicle that stands still",
        (f"{_LOGS}::test_an_ego_vehicle_that_stands_still", f"{_POSES}::test_standstill_and_odd_timestamps"),
    ),
    48: ("a camera that sees its own bonnet", (f"{_LOGS}::test_a_camera_that_sees_its_own_bonnet",)),
    49: (
        "a pickle that tries to run code",
        ("tests/logs/test_pickle_reader.py", "tests/faults/test_bad_input.py::test_a_pickle_that_tries_to_run_code"),
    ),
    50: (
        "distortion that folds back outside its valid radius: what it would bring into the image; LiDAR colouring",
        (
            f"{_EFFECTS}::test_what_would_fold_back_touches_no_pixel",
            "tests/scene/test_scene_points.py::test_distortion_that_folds_back_is_unseen",
        ),
    ),
    51: (
        "a point that moves down the image as fast as its rows are read, or faster",
        ("tests/render/test_render_shutter.py::test_points_that_outrun_the_rows_stay_within_the_readout",),
    ),
    52: (
        "gain towards 0, and without bound: applied up to a factor of 55",
        ("tests/effects/test_exposure.py::test_neutral_undoes_what_a_gain_does_and_stays_finite",),
    ),
    53: (
        "view direction at zero distance",
        ("tests/scene/test_spherical_harmonics.py::test_a_direction_at_zero_distance_is_finite",),
    ),
    54: (
        "exposure time 0: no motion blur, the same bits",
        (
            "tests/effects/test_apply_plan.py::test_an_exposure_of_no_time_is_no_blur",
            "tests/render/test_render_motion_blur.py::test_views_without_blur_are_rendered_as_ever",
        ),
    ),
}
