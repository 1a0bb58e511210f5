"""Registration by kernel correlation: no correspondences, all pairs count."""

from jaxreg.correlation.kernel import KernelCorrelation as KernelCorrelation
from jaxreg.correlation.pairs import kernel_correlation as kernel_correlation
