// The strip over the curves that shows which chunk owns which steps, with its hairlines and bands.

import { css } from "../console/live/style.js";
import { t } from "../site/sentences.js";

export const LANE = 20; // height over the plot [px]
const LEAST = 4; // least average width of a chunk [px] at which each has its own tint
const SPACED = 12; // least average distance of hairlines [px] at which they are drawn
const ROOM = 8; // space around a number [px]

export class Lane {
  #chunks;

  constructor(chunks) {
    this.#chunks = chunks;
  }

  /** Draw under the curves: bands where several chunks contributed, and a hairline where another chunk takes over. */
  behind(ctx, x, { top, height, width }) {
    ctx.fillStyle = css("--mark-overlap");
    for (const [from, to] of this.#chunks.overlaps) ctx.fillRect(x(from), top, Math.max(1, x(to) - x(from)), height);
    const seen = this.#visible(x, width);
    if (seen.count * SPACED * devicePixelRatio > width) return;
    ctx.fillStyle = css("--mark-chunk");
    ctx.globalAlpha = 0.55;
    for (const { from } of seen.spans) ctx.fillRect(Math.round(x(from)), top, Math.max(1, Math.round(devicePixelRatio)), height);
    ctx.globalAlpha = 1;
  }

  /** Draw the strip itself from `top` on; `chosen` is the chunk under the cursor. */
  strip(ctx, x, { left, top, width, chosen }) {
    const tall = (LANE - 4) * devicePixelRatio;
    const seen = this.#visible(x, width);
    ctx.font = `${13 * devicePixelRatio}px ${css("--font")}`;
    ctx.textBaseline = "middle";
    ctx.textAlign = "center";
    for (const span of seen.spans) this.#span(ctx, x, span, { top, tall, chosen, legible: seen.legible });
    if (!seen.legible) this.#summary(ctx, t("page.replay.many_chunks", "{n} chunks: drag over the curves to look closer", { n: seen.count }), { left, top, width, tall });
  }

  /** Return the spans in view, every second one marked as `odd`, and whether there is room for them (`legible`). */
  #visible(x, width) {
    const spans = this.#chunks.spans
      .map((span, index) => ({ ...span, odd: index % 2 === 1 }))
      .filter(({ from, to }) => x(to) >= x.left && x(from) <= x.left + width);
    return { spans, count: spans.length, legible: spans.length * LEAST * devicePixelRatio <= width };
  }

  #span(ctx, x, { from, to, id, odd }, { top, tall, chosen, legible }) {
    const [begin, end] = [x(from), x(to)];
    const wide = Math.max(1, end - begin);
    const own = id === chosen && legible;
    ctx.globalAlpha = own ? 1 : legible && odd ? 0.24 : 0.42;
    ctx.fillStyle = css(own ? "--curve-4" : id === 0 ? "--warn" : "--mark-chunk");
    ctx.fillRect(begin, top, wide, tall);
    ctx.globalAlpha = 1;
    const name = id === 0 ? t("page.replay.held", "held") : String(id);
    const middle = (Math.max(begin, x.left) + Math.min(end, x.right)) / 2;
    if (!legible || ctx.measureText(name).width + ROOM * devicePixelRatio > Math.min(end, x.right) - Math.max(begin, x.left)) return;
    ctx.fillStyle = css(own ? "--panel" : "--text-strong");
    ctx.fillText(name, middle, top + tall / 2 + devicePixelRatio);
  }

  #summary(ctx, text, { left, top, width, tall }) {
    ctx.fillStyle = css("--text-strong");
    ctx.fillText(text, left + width / 2, top + tall / 2 + devicePixelRatio, width);
  }
}
