"""Reading and writing scans, poses and graphs."""

import lazy_loader


# Names are in the stub beside this file, and imported when they are first used: who
# asks for help, a version, or what a file holds, need not wait for JAX.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
