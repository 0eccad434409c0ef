// Numbers as people read them.

export function bytes(count: number | null | undefined): string {
  if (count === null || count === undefined || !Number.isFinite(count)) return "–";
  const units = ["B", "kB", "MB", "GB", "TB"];
  let value = count;
  let unit = 0;
  while (value >= 1000 && unit < units.length - 1) {
    value /= 1000;
    unit++;
  }
  return `${unit === 0 || value >= 100 ? value.toFixed(0) : value.toFixed(1)} ${units[unit] ?? ""}`;
}

export function duration(seconds: number | null | undefined): string {
  if (seconds === null || seconds === undefined || !Number.isFinite(seconds)) return "–";
  if (seconds < 0.95) return "< 1 s";
  if (seconds < 60) return `${seconds < 10 ? seconds.toFixed(1).replace(/\.0$/, "") : Math.round(seconds).toString()} s`;
  const minutes = Math.floor(seconds / 60);
  if (minutes < 60) return `${minutes.toString()} min ${Math.round(seconds % 60).toString()} s`;
  return `${Math.floor(minutes / 60).toString()} h ${(minutes % 60).toString()} min`;
}

/** A time that is estimated, no finer than it can be known. */
export function about(seconds: number): string {
  if (seconds < 95) return `about ${String(Math.max(5, Math.round(seconds / (seconds < 30 ? 5 : 10)) * (seconds < 30 ? 5 : 10)))} s`;
  const minutes = seconds < 3600 ? Math.round(seconds / 60) : Math.round(seconds / 600) * 10;
  return minutes < 60 ? `about ${String(minutes)} min` : `about ${String(Math.floor(minutes / 60))} h ${String(minutes % 60)} min`;
}

export function count(value: number): string {
  if (value < 10_000) return value.toString();
  return value < 1e6 ? `${(value / 1e3).toFixed(0)} k` : `${(value / 1e6).toFixed(value < 1e7 ? 2 : 1)} M`;
}

export function percent(fraction: number): string {
  return `${Math.floor(Math.max(0, Math.min(1, fraction)) * 100).toString()} %`;
}

export function ago(time: string | null, now: number = Date.now()): string {
  if (time === null) return "–";
  const seconds = (now - Date.parse(time)) / 1000;
  if (seconds < 45) return "just now";
  if (seconds < 3600) return `${Math.max(1, Math.round(seconds / 60)).toString()} min ago`;
  if (seconds < 86400) return `${Math.round(seconds / 3600).toString()} h ago`;
  return new Date(time).toLocaleDateString(undefined, { day: "numeric", month: "short", year: "numeric" });
}

export function moment(time: string | null): string {
  return time === null ? "–" : new Date(time).toLocaleString();
}

/** A length in mm with two digits, or in m from one meter on. */
export function millimeters(meters: number | null | undefined): string {
  if (meters === null || meters === undefined) return "not known";
  if (meters >= 1) return `${meters.toFixed(meters < 10 ? 1 : 0)} m`;
  const value = meters * 1000;
  return `${value.toFixed(value < 1 ? 2 : value < 10 ? 1 : 0)} mm`;
}

export function plural(number: number, word: string): string {
  return `${number.toLocaleString("en")} ${word}${number === 1 ? "" : "s"}`;
}
