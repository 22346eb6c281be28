"""The ``layerjax`` command: words in, tables, pictures and result directories out. No rule of inference lives here."""

from fits.cli.parser import main as main
