"""Pictures of surfaces without a screen: the eye, light, colours and their meaning, the child that draws."""
