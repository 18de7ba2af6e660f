// The ghost of a target: "eva:aimed" has the station's answer about a target, or null if there is none.

export function aimGhost(scene) {
  document.addEventListener("eva:aimed", ({ detail }) => scene.aim(detail?.ok && detail.links?.length ? detail.links : null));
}
