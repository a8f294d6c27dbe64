"""What `import wavequake as wq` offers beyond single functions of the package."""
