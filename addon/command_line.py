"""blender --command fewview."""
