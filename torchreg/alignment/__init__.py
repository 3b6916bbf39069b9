"""Articulated alignment: the pose of a shape in 3-D points.

Besides the public names, other rooms may use `label_frames`, and tracking, which builds on them,

- the problem: `AlignProblem`, `centered_problem`, `alignment_cost`, `GaussianPosePrior`, `joint_precision`,
  `model_size`; least squares: `Objective`, `surface_objective`;
- the annealed EM: `anneal`, `narrowing`, `outlier_level`;
- the surface fit: `refine_surface`, `surface_steps`, `surface_noise`, `pose_covariance`, `SurfaceResult`;
- the search for poses: `PoseSearch`, `StartSource`, `HoldsProposer`, `Candidates`, `Plan`;
- evidence beside the data: `Factor`, `FreeSpaceTerm`, `free_space_loss`; what is known beforehand: `KnownDofs`;
  measured keypoints: `MeasuredKeypoints`, `keypoint_skin`;
- shape coefficients: `fitted_rig`, `scan_normals`, `surface_skins`, `plausible_precision`, `robust_rows`, `RobustRows`;
  what lies outside of a closed scan: `OutsideTerm`;
  clothes: `CLOTH`, `clothed_rig`, `may_be_clothed`; the network that proposes people: `PersonProposer`, `is_body`;
- what can be trusted: `Evidence`, `weigh`, `hardly_gains`, `limb_ends`, `end_motions`, `end_variances`,
  `correlated_count`, `neighbor_correlation`, `dof_confidence`, `unseen_share`, `overlap`, `own_shares`,
  `SurfaceError`; in words `spread_of`;
- checks of input: `check_skin`, `floating_origin`, `warn_about_units`, `warn_about_degenerate`;
- numbers: `ANNEALING`, `CALIBRATION`, `CLUSTERS`, `INLIER_SHARE`, `INTRUSION`, `OFF_SURFACE`, `PRIOR_SHARE`,
  `SEARCH_BUDGET`, `SHAPE_CALIBRATION`, `SURFACE_FIT`, `UNITS`.
"""
