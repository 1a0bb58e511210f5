"""The chi-squared law, on the host: SciPy's, imported at use as it takes 0.14 s."""


def exceeded_with(probability: float, dof: int) -> float:
    """The value that noise of so many degrees of freedom exceeds with a probability."""
    from scipy.special import chdtri

    return float(chdtri(dof, probability))


def probability_above(value: float, dof: int) -> float:
    """With which noise of so many degrees of freedom exceeds a value."""
    from scipy.special import chdtrc

    return float(chdtrc(dof, value))
