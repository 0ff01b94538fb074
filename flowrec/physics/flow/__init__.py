"""Chip and boundary values to a flow field.

assembly: of sparse matrices. level_set, contour_smoothing: where the walls of a mask lie. grid, wall_stencils,
momentum, streamfunction: the discrete Navier-Stokes equations. linear_solver, newton_solver: their solution. stress,
generalised: both for a viscosity that depends on the shear rate. centre_values: its velocity at the centres of pixels.
sensitivities: its derivatives with respect to boundary values and fluid. solver: the stage. velocity_stencil, sampling:
values between pixel centres and errors of a finished field. uncertainty: what is not known of a field. map_error: that
as one number.
"""
