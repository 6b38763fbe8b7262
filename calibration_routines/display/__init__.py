"""SLM response, mask alignment, hologram photographs."""
