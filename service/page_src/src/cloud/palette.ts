// How numbers become colors, in the shader and in the legend alike.

export type ColorBy = "rgb" | "error" | "height" | "views" | "spread" | "part" | "scan" | "plane_error";

export const LABELS: Record<ColorBy, string> = {
  rgb: "Color",
  error: "Expected error",
  height: "Height",
  views: "Number of views",
  spread: "Color spread",
  part: "Part",
  scan: "Scan",
  plane_error: "Distance from plane",
};

export const UNITS: Record<ColorBy, string> = {
  rgb: "",
  error: "mm",
  height: "m",
  views: "images",
  spread: "gray values",
  part: "",
  scan: "",
  plane_error: "mm",
};

/** Values are multiplied by this for the legend. */
export const LEGEND_FACTOR: Partial<Record<ColorBy, number>> = { plane_error: 1000, error: 1000 };

/** Names, not amounts: neighbors get colors that differ. */
export const CATEGORIES: ReadonlySet<ColorBy> = new Set<ColorBy>(["part"]);

/** Amounts with a sign, shown round zero. */
export const SIGNED: ReadonlySet<ColorBy> = new Set<ColorBy>(["plane_error"]);

const VIRIDIS: [number, number, number][] = [
  [68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141],
  [39, 173, 129], [92, 200, 99], [170, 220, 50], [253, 231, 37],
];
const DIVERGING: [number, number, number][] = [
  [33, 102, 172], [103, 169, 207], [209, 229, 240], [247, 247, 247], [253, 219, 199], [239, 138, 98], [178, 24, 43],
];

/** 256 RGBA colors. */
export function ramp(by: ColorBy): Uint8Array<ArrayBuffer> {
  const out = new Uint8Array(256 * 4);
  for (let i = 0; i < 256; i++) {
    const color = CATEGORIES.has(by) ? category(i) : between(SIGNED.has(by) ? DIVERGING : VIRIDIS, i / 255);
    out.set([...color, 255], 4 * i);
  }
  return out;
}

/** The ramp as a CSS gradient. */
export function gradient(by: ColorBy): string {
  const stops = (SIGNED.has(by) ? DIVERGING : VIRIDIS).map((color) => `rgb(${color.join(" ")})`);
  return `linear-gradient(to right, ${stops.join(", ")})`;
}

function between(stops: [number, number, number][], t: number): [number, number, number] {
  const place = t * (stops.length - 1);
  const first = stops[Math.floor(place)] ?? [0, 0, 0];
  const second = stops[Math.min(stops.length - 1, Math.floor(place) + 1)] ?? first;
  const part = place - Math.floor(place);
  return [0, 1, 2].map((a) => Math.round((first[a] ?? 0) * (1 - part) + (second[a] ?? 0) * part)) as [number, number, number];
}

/** Hues a golden angle apart, in three lightnesses. */
function category(i: number): [number, number, number] {
  const hue = (i * 137.508) % 360;
  const light = [0.58, 0.7, 0.46][i % 3] ?? 0.6;
  const channel = (shift: number): number => {
    const k = (shift + hue / 30) % 12;
    return Math.round(255 * (light - 0.55 * Math.min(light, 1 - light) * Math.max(-1, Math.min(k - 3, 9 - k, 1))));
  };
  return [channel(0), channel(8), channel(4)];
}
