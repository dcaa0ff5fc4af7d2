"""Surfaces in notebooks: a widget around the viewer's element, whose bytes travel over the widget's comm."""
