// Where the robot would go, as a ghost: "eva:aimed" has the station's answer about a target, or null where there is none.

export function aimGhost(scene) {
  document.addEventListener("eva:aimed", ({ detail }) => scene.aim(detail?.ok && detail.links?.length ? detail.links : null));
}
