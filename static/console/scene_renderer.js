// What draws the 3D scene: WebGL by a graphics card, or by the processor where there is none.

import { three } from "./scene_shapes.js";

/** Edges are smoothed where a graphics card does it; in software that would cost more than all the rest. */
export function rendererIn(element) {
  const THREE = three();
  let renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true });
  const software = bySoftware(renderer);
  if (software) {
    renderer.dispose();
    renderer.forceContextLoss();
    renderer = new THREE.WebGLRenderer({ antialias: false, alpha: true });
  }
  renderer.setPixelRatio(software ? 1 : Math.min(window.devicePixelRatio, 1.5));
  element.append(renderer.domElement);
  return { renderer, software };
}

function bySoftware(renderer) {
  const gl = renderer.getContext();
  const names = gl.getExtension("WEBGL_debug_renderer_info");
  return names !== null && /swiftshader|llvmpipe|software/i.test(gl.getParameter(names.UNMASKED_RENDERER_WEBGL));
}
