"""Pictures of surfaces without a screen: the eye, light, colours and their meaning, lettering, the child that draws."""
