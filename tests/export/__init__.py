"""Tests of exports, which share a method that knows the truth and readers of what is written."""
