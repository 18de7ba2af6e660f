// A list whose rows can be reordered: dragged by their handles, or moved by the arrow keys on a handle.

/** `moved(from, to)` is called for each row that moves; its owner then draws the list again. */
export function orderable(list, moved) {
  const rows = () => [...list.children];
  const indexOf = (target) => rows().indexOf(target.closest("li"));
  const move = (from, to) => {
    if (to === from || to < 0 || to >= rows().length) return from;
    moved(from, to);
    rows()[to].querySelector("[data-handle]").focus({ preventScroll: true });
    return to;
  };
  list.addEventListener("keydown", (event) => {
    const step = { ArrowUp: -1, ArrowDown: 1 }[event.key];
    if (!step || !event.target.closest("[data-handle]")) return;
    event.preventDefault();
    const from = indexOf(event.target);
    move(from, from + step);
  });
  list.addEventListener("pointerdown", (event) => {
    const handle = event.target.closest("[data-handle]");
    if (!handle || handle.disabled || event.button !== 0) return;
    event.preventDefault();
    let at = indexOf(handle);
    handle.focus({ preventScroll: true });
    list.setPointerCapture(event.pointerId);
    list.dataset.dragging = "";
    const drag = ({ clientY }) => {
      const middles = rows().map((row) => row.getBoundingClientRect()).map(({ top, height }) => top + height / 2);
      const above = middles.filter((middle, index) => index !== at && middle < clientY).length;
      at = move(at, above);
    };
    const end = () => {
      delete list.dataset.dragging;
      list.removeEventListener("pointermove", drag);
      for (const kind of ["pointerup", "pointercancel"]) list.removeEventListener(kind, end);
    };
    list.addEventListener("pointermove", drag);
    for (const kind of ["pointerup", "pointercancel"]) list.addEventListener(kind, end);
  });
}
