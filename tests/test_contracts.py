"""Abstract or final: abstract classes promise, final ones keep it, nothing is undone.

A method that a class defines is new or abstract above it, so that what runs is read in
one place; a class that is made has no subclass.
"""

import importlib
import inspect
import pkgutil

import jaxreg as jr


#: Classes that are made and have subclasses all the same.
BASES = {
    "BriefModule": "gives a module its line for people, nothing else",
    "Options": "fields of all commands",
    "KnownOptions": "fields of the commands that take what is known of the world",
    "SearchOptions": "fields of the commands that search",
    "ModelOptions": "fields of the commands that write scans in one frame",
}
#: Names of the top level but modules; more belong into namespaces.
MOST_NAMES = 75


def _classes() -> list[type]:
    """All classes that the package defines."""
    found = set()
    for module in pkgutil.walk_packages(jr.__path__, "jaxreg."):
        if module.name.endswith("__main__"):
            continue
        inside = vars(importlib.import_module(module.name)).values()
        found |= {
            x for x in inside if inspect.isclass(x) and x.__module__ == module.name
        }
    return sorted(found, key=lambda x: (x.__module__, x.__qualname__))


CLASSES = _classes()


def _is_abstract(cls: type) -> bool:
    return cls.__name__.lstrip("_").startswith("Abstract")


def _methods(cls: type) -> set[str]:
    """Names of the methods and properties that the body of a class defines.

    But for hooks: dataclasses write `__init__`, `__repr__` is a line for people, and
    equinox calls `__check_init__` of every class.
    """
    kinds = (property, classmethod, staticmethod)
    return {
        name
        for name, value in vars(cls).items()
        if (callable(value) or isinstance(value, kinds))
        and (not name.startswith("__") or name == "__call__")
    }


def _is_promised(cls: type, name: str) -> bool:
    return getattr(vars(cls)[name], "__isabstractmethod__", False)


def test_no_method_that_runs_is_overridden():
    wrong = []
    for cls in CLASSES:
        above = [b for b in cls.__mro__[1:] if b.__module__.startswith("jaxreg")]
        for name in _methods(cls):
            first = next((b for b in above if name in vars(b)), None)
            if first and not _is_promised(first, name):
                wrong.append(f"{cls.__name__}.{name} overrides {first.__name__}'s")
    assert not wrong, "\n".join(wrong)


def test_classes_that_are_made_have_no_subclasses():
    wrong = [
        f"{cls.__name__} derives from {base.__name__}"
        for cls in CLASSES
        for base in cls.__bases__
        if base.__module__.startswith("jaxreg")
        and not _is_abstract(base)
        and base.__name__ not in BASES
    ]
    assert not wrong, "\n".join(wrong)


def test_contracts_are_few_methods_and_stand_at_the_top():
    for cls in CLASSES:
        abstract = [name for name in _methods(cls) if _is_promised(cls, name)]
        assert len(abstract) <= 5, f"{cls.__name__}: {abstract}"
    assert set(jr.__all__) >= {
        "AbstractAverager",
        "AbstractDynamics",
        "AbstractEnergy",
        "AbstractIndex",
        "AbstractKernel",
        "AbstractPrior",
        "AbstractRegistrar",
        "AbstractResampler",
        "AbstractResidual",
        "AbstractStep",
    }
    public = [getattr(jr, name) for name in jr.__all__]
    assert len([x for x in public if not inspect.ismodule(x)]) <= MOST_NAMES
