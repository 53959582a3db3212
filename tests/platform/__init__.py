"""Tests of the stable platform."""
