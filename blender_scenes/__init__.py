"""Scenes written as text, rendered to sparse views with exact cameras and the true mesh.

The modules need Blender's Python (`bpy`).
"""
