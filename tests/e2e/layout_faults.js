// A sentence for each piece of text on this page that laps over another one, or is cut off where nothing scrolls.
() => {
  const faults = new Set();
  const named = (node) => `'${node.textContent.trim().replace(/\s+/g, " ")}'`;
  const covers = (style) => ["fixed", "absolute", "sticky"].includes(style.position) && !/, 0\)$/.test(style.backgroundColor);
  const hidden = (element) => !element.checkVisibility({ opacityProperty: true, visibilityProperty: true });
  const AXES = [["overflowX", "left", "right"], ["overflowY", "top", "bottom"]];

  /** What can be seen of a line of text, and on which layer; says where something cuts it off. */
  function seen(node, line) {
    const piece = { node, layer: null, left: line.left, top: line.top, right: line.right, bottom: line.bottom };
    for (let one = node.parentElement; one && one !== document.body; one = one.parentElement) {
      const style = getComputedStyle(one);
      const box = one.getBoundingClientRect();
      for (const [overflow, from, to] of AXES) {
        if (style[overflow] === "visible") continue;
        const beyond = piece[from] < box[from] - 1.5 || piece[to] > box[to] + 1.5;
        const meant = /auto|scroll/.test(style[overflow]) || style.textOverflow === "ellipsis";
        if (beyond && !meant) faults.add(`${named(node)} is cut off`);
        piece[from] = Math.max(piece[from], box[from]);
        piece[to] = Math.min(piece[to], box[to]);
      }
      if (!piece.layer && covers(style)) piece.layer = one;
      if (style.position !== "fixed") continue;
      if (piece.right > innerWidth + 1.5 || piece.bottom > innerHeight + 1.5) faults.add(`${named(node)} is cut off`);
      break;
    }
    return piece;
  }

  function lapsOver(one, other) {
    const wide = Math.min(one.right, other.right) - Math.max(one.left, other.left);
    const high = Math.min(one.bottom, other.bottom) - Math.max(one.top, other.top);
    return one.node !== other.node && one.layer === other.layer && wide > 2 && high > 4;
  }

  const pieces = [];
  const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (texts.nextNode()) {
    const node = texts.currentNode;
    const element = node.parentElement;
    if (!node.textContent.trim() || hidden(element) || element.closest(".visually-hidden, option, script, style")) continue;
    const range = document.createRange();
    range.selectNodeContents(node);
    pieces.push(...[...range.getClientRects()].map((line) => seen(node, line)));
  }
  for (const [index, one] of pieces.entries()) {
    for (const other of pieces.slice(0, index)) {
      if (lapsOver(other, one)) faults.add(`${named(other.node)} laps over ${named(one.node)}`);
    }
  }
  const { scrollWidth, clientWidth } = document.documentElement;
  if (scrollWidth > clientWidth) faults.add(`the page is ${scrollWidth} wide in a window of ${clientWidth}`);
  return [...faults];
}
