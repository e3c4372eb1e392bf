"""What a calibration is good for: at the tool, beside other models, validated; its findings."""
