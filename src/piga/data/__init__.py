"""Example records that ship with the package."""
