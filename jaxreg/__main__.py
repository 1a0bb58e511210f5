"""`python -m jaxreg` is the command `jaxreg`."""

from jaxreg.app.cli.main import command


if __name__ == "__main__":
    command()
