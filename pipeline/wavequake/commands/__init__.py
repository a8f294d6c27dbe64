"""The commands of the command line, by what they are about; `wavequake.cli` puts them together."""
