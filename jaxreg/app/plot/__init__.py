"""Pictures and pages of results; needs the extra `app`."""

import lazy_loader


# Names are in the stub beside this file: a page of scans needs no averaging.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
