// Line charts as SVG: with a readout under the pointer or by arrow keys, and the numbers as a table for who wants them.

import type { RefObject } from "preact";
import { useEffect, useRef, useState } from "preact/hooks";

export interface Series {
  name: string;
  values: (number | null)[];
  kind: "before" | "after" | "reference";
}

interface Props {
  title: string;
  unit: string;
  series: Series[];
  /** What the places on the x axis are called, for the readout. */
  labels: string[];
  xName: string;
  /** Amounts that say something only in full: the axis begins at 0. */
  fromZero?: boolean;
  chosen?: number | null;
  choose?: (place: number) => void;
}

const HEIGHT = 220;
const [LEFT, RIGHT, TOP, BOTTOM] = [46, 10, 12, 26];

export function Chart({ title, unit, series, labels, xName, fromZero = false, chosen = null, choose }: Props) {
  const [hover, setHover] = useState<number | null>(null);
  const [frame, width] = useWidth(640);
  const n = labels.length;
  const numbers = series.flatMap((one) => one.values).filter((value): value is number => value !== null && Number.isFinite(value));
  if (n === 0 || numbers.length === 0) return null;
  const ticks = ticksOf(fromZero ? 0 : Math.min(...numbers), Math.max(...numbers));
  const [low, high] = [ticks[0] ?? 0, ticks.at(-1) ?? 1];
  const x = (place: number): number => LEFT + (n === 1 ? 0.5 : place / (n - 1)) * (width - LEFT - RIGHT);
  const y = (value: number): number => TOP + (1 - (value - low) / (high - low)) * (HEIGHT - TOP - BOTTOM);
  const at = hover ?? chosen;
  const placeOf = (event: PointerEvent): number => {
    const box = (event.currentTarget as SVGElement).getBoundingClientRect();
    const part = ((event.clientX - box.left) / box.width * width - LEFT) / (width - LEFT - RIGHT);
    return Math.max(0, Math.min(n - 1, Math.round(part * (n - 1))));
  };
  const steps: Record<string, number> = { ArrowLeft: -1, ArrowRight: 1, PageUp: -10, PageDown: 10 };
  const key = (event: KeyboardEvent): void => {
    const step = steps[event.key];
    if (step !== undefined) {
      event.preventDefault();
      const place = Math.max(0, Math.min(n - 1, (at ?? 0) + step));
      setHover(place);
    } else if (event.key === "Enter" && at !== null) choose?.(at);
  };
  return (
    <figure class="chart" ref={frame}>
      <figcaption>
        <span class="chart-title">{title}</span>
        <span class="legend">{series.map((one) => <span key={one.name}><span class={`swatch swatch-${one.kind}`} aria-hidden="true" />{one.name}</span>)}</span>
      </figcaption>
      <svg
        viewBox={`0 0 ${String(width)} ${String(HEIGHT)}`} role="img" tabIndex={0}
        aria-label={`${title}: ${series.map((one) => `${one.name} on average ${format(mean(one.values))} ${unit}`).join(", ")}. Arrow keys read single values.`}
        onPointerMove={(event) => { setHover(placeOf(event)); }} onPointerLeave={() => { setHover(null); }}
        onClick={(event) => { choose?.(placeOf(event as unknown as PointerEvent)); }} onKeyDown={key} onBlur={() => { setHover(null); }}
      >
        {ticks.map((tick) => (
          <g key={tick}>
            <line x1={LEFT} x2={width - RIGHT} y1={y(tick)} y2={y(tick)} class="grid" />
            <text x={LEFT - 6} y={y(tick) + 4} class="tick" text-anchor="end">{format(tick)}</text>
          </g>
        ))}
        <text x={LEFT} y={HEIGHT - 6} class="tick">{xName} {labels[0]}</text>
        <text x={width - RIGHT} y={HEIGHT - 6} class="tick" text-anchor="end">{labels[n - 1]}</text>
        {series.map((one) => <path key={one.name} d={path(one.values, x, y)} class={`curve curve-${one.kind}`} />)}
        {at !== null && <line x1={x(at)} x2={x(at)} y1={TOP} y2={HEIGHT - BOTTOM} class="cross" />}
        {at !== null && series.map((one) => {
          const value = one.values[at] ?? null;
          return value === null ? null : <circle key={one.name} cx={x(at)} cy={y(value)} r="3.5" class={`spot spot-${one.kind}`} />;
        })}
      </svg>
      <p class="readout small" aria-live="polite">
        {at === null ? <span class="quiet">{series.map((one) => `${one.name} ⌀ ${format(mean(one.values))} ${unit}`).join("   ")}</span>
          : `${xName} ${labels[at] ?? ""}:  ${series.map((one) => `${one.name} ${format(one.values[at] ?? null)} ${unit}`).join("   ")}`}
      </p>
    </figure>
  );
}

/** The width of an element, px: what is drawn is drawn at its own size, so that letters keep theirs. */
function useWidth(first: number): [RefObject<HTMLElement | null>, number] {
  const element = useRef<HTMLElement>(null);
  const [width, setWidth] = useState(first);
  useEffect(() => {
    const watch = new ResizeObserver(([entry]) => { setWidth(Math.max(200, Math.floor(entry?.contentRect.width ?? first))); });
    if (element.current !== null) watch.observe(element.current);
    return () => { watch.disconnect(); };
  }, []);
  return [element, width];
}

function path(values: (number | null)[], x: (place: number) => number, y: (value: number) => number): string {
  let pen = false;
  return values.map((value, place) => {
    if (value === null || !Number.isFinite(value)) {
      pen = false;
      return "";
    }
    const command = pen ? "L" : "M";
    pen = true;
    return `${command}${x(place).toFixed(1)} ${y(value).toFixed(1)}`;
  }).join("");
}

function mean(values: (number | null)[]): number | null {
  const known = values.filter((value): value is number => value !== null && Number.isFinite(value));
  return known.length === 0 ? null : known.reduce((sum, value) => sum + value, 0) / known.length;
}

function format(value: number | null): string {
  if (value === null) return "–";
  return Math.abs(value) >= 100 ? value.toFixed(0) : Math.abs(value) >= 10 ? value.toFixed(1) : value.toFixed(2);
}

function ticksOf(low: number, high: number): number[] {
  const span = Math.max(high - low, Math.abs(high) * 1e-3, 1e-6);
  const raw = span / 4;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 2.5, 5, 10].map((factor) => factor * power).find((candidate) => candidate >= raw) ?? raw;
  const ticks: number[] = [];
  for (let k = Math.floor(low / step); k <= Math.ceil(high / step); k++) ticks.push(Number((k * step).toPrecision(10)));
  return ticks.length > 1 ? ticks : [ticks[0] ?? low, (ticks[0] ?? low) + step];
}
