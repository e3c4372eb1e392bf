"""Every tolerance of the tests, with its reason. Nothing is compared with a bare number."""

KINEMATICS = 1e-12
"""[m or 1] Symbolic kinematics against Pinocchio: a few hundred roundings of numbers near 1."""

CLOSED = 1e-11
"""[m] Loops closed twice, each to 1e-12."""

CLOSED_FORM = 1e-9
"""[m] Closed loops against the closed forms, over the whole workspace."""

TRUTH_BACK = 1e-9
"""[m] Offsets from perfect readings: what no gauge of this century resolves."""

DERIVATIVE = 1e-7
"""[1] Exact against central differences, relative to the largest entry: steps of 1e-5 to 1e-6
leave truncation and rounding errors of about 1e-9."""

DESIGN_MM = 0.005e-3
"""[m] Offsets of Table 1 against numbers that were computed independently and are printed with
four decimals of a mm."""

FOUR_DECIMALS_MM = 0.00006e-3
"""[m] Numbers printed with four decimals of a mm."""

THREE_DECIMALS_MM = 0.0006e-3
"""[m] Numbers printed with three decimals of a mm."""

PAPER_MM = 0.0055e-3
"""[m] Rounding of the paper's Table 1, which has two decimals of a mm."""

PRINTED = 6e-6
"""[1] Coefficients printed with five decimals."""

SAME_OPTIMUM = 1e-9
"""[m] One optimum by two routes of Ipopt, each to a gradient of 1e-6 on the scaled problem."""

SAME_NUMBER = 1e-6
"""[1] One number by two formulas of linear algebra, or two evaluations of one optimum."""

LAST_SIGMA = 1e-6
"""[1] Quantities of the last σ against those of the σ before it, which differ in the experiment by
the mounting alone."""
