from figures.fixtures import density, drawbar, plate, rut, unconverged  # noqa: F401
