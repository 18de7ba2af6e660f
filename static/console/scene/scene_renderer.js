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

const cheaper = new WeakMap(); // by the material it stands for

/** Light the object corner by corner instead of pixel by pixel: what a processor can draw fifteen times a second. */
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
