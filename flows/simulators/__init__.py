"""What simulators ask of GenRe: images at any pose and moment, over HTTP or gRPC, or as a gymnasium environment."""
