"""Articulated alignment: the pose of a shape in 3-D points.

Besides the public names, other rooms may use `AlignRecord` and `label_frames`, and tracking, which builds on them,

- the problem: `AlignProblem`, `centered_problem`, `alignment_cost`, `GaussianPosePrior`;
- the annealed EM: `anneal`, `outlier_level`;
- the surface fit: `refine_surface`, `surface_steps`, `surface_noise`, `pose_covariance`, `SurfaceResult`;
- the search for poses: `PoseSearch`, `fit_candidates`, `score_candidates`;
- the evidence for poses: `Evidence`, `weigh`, `hardly_gains`, `confidence_of`, `end_motions`, `end_variances`,
  `limb_ends`, `share_beside`, `CALIBRATION`, and of free space `FreeSpaceTerm`, `INTRUSION`;
- checks of input: `check_skin`, `floating_origin`, `warn_about_units`, `warn_about_degenerate`;
- numbers: `ANNEALING`, `CLUSTERS`, `INLIER_SHARE`, `OFF_SURFACE`, `PRIOR_SHARE`, `SEARCH_BUDGET`, `SURFACE_FIT`,
  `UNITS`.
"""
