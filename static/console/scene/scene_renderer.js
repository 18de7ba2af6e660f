// The renderer of the 3D scene: WebGL with a graphics card or, without one, on the processor.

import { three } from "./scene_shapes.js";

/**
 * Make the renderer in `element` and return {renderer, software}. Edges are smoothed only by a graphics card; in software that
 * would cost more than everything else.
 */
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

const cheaper = new WeakMap(); // material -> its cheaper replacement

/** Light the object per vertex instead of per pixel, which a processor can draw fifteen times a second. */
export function lightenWork(object) {
  object.traverse((mesh) => {
    if (!mesh.material?.isMeshPhongMaterial) return;
    if (!cheaper.has(mesh.material)) cheaper.set(mesh.material, byCorner(mesh.material));
    mesh.material = cheaper.get(mesh.material);
  });
}

function byCorner({ color, transparent, opacity, depthWrite, polygonOffset, polygonOffsetFactor, polygonOffsetUnits }) {
  const look = { color, transparent, opacity, depthWrite, polygonOffset, polygonOffsetFactor, polygonOffsetUnits };
  return new (three().MeshLambertMaterial)(look);
}
