"""`register`: the pose of one point set in the frame of another."""

from jaxreg.registration.register import register as register
