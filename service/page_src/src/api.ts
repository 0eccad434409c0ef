// Talking to the server: the key is kept by the browser, and problems become errors that say what to do.

import type { Page } from "./types";

const KEPT = "lvba-key";
let key: string | null = stored(() => sessionStorage.getItem(KEPT) ?? localStorage.getItem(KEPT));

/** A browser may refuse to keep anything; then the key is in memory only. */
function stored<T>(act: () => T): T | null {
  try {
    return act();
  } catch {
    return null;
  }
}

/** Asks with this key from now on, also after a reload of the page; stay: also after the browser was closed. */
export function useKey(value: string, stay: boolean): void {
  forgetKey();
  key = value;
  stored(() => { (stay ? localStorage : sessionStorage).setItem(KEPT, value); });
}

export function forgetKey(): void {
  key = null;
  tickets.clear();
  stored(() => { sessionStorage.removeItem(KEPT); });
  stored(() => { localStorage.removeItem(KEPT); });
}

/** Calls `act` when the server does not take the key any more. */
export function onLocked(act: () => void): void {
  addEventListener("lvba-locked", act);
}

export function headers(): Record<string, string> {
  return key === null ? {} : { Authorization: `Bearer ${key}` };
}

/** Code of what was refused of a key that is not used any more: that says nothing about the one that is. */
export const KEY_CHANGED = "key-changed";

/** What the server refused, and why (RFC 9457). */
export class Problem extends Error {
  constructor(
    readonly status: number,
    readonly code: string,
    readonly cause_: string,
    readonly hint: string,
    readonly errors: { where: string; message: string }[] = [],
    readonly retryAfter: number | null = null,
  ) {
    super(cause_);
  }
}

export async function problemOf(response: Response): Promise<Problem> {
  const retry = Number(response.headers.get("Retry-After") ?? "NaN");
  const after = Number.isFinite(retry) ? retry : null;
  try {
    const body = (await response.json()) as Record<string, unknown>;
    const text = (name: string): string => (typeof body[name] === "string" ? body[name] : "");
    const errors = Array.isArray(body["errors"]) ? (body["errors"] as { where: string; message: string }[]) : [];
    return new Problem(response.status, text("code"), text("detail") || text("title"), text("hint"), errors, after);
  } catch {
    return new Problem(response.status, "", `The server answered ${response.status.toString()}.`, "Try again.", [], after);
  }
}

/** The answer of the server. Throws Problem for what it refuses, TypeError where it cannot be reached. */
export async function request(path: string, init: RequestInit = {}): Promise<Response> {
  const asked = key;
  const response = await fetch(path, { ...init, headers: { ...headers(), ...(init.headers as Record<string, string> | undefined) } });
  if (response.ok) return response;
  const problem = await problemOf(response);
  // another key may have been given while the answer was read
  if (response.status === 401 && asked !== key) throw new Problem(401, KEY_CHANGED, "Another key is used now.", "Try again.");
  if (response.status === 401 && key !== null) dispatchEvent(new Event("lvba-locked"));
  throw problem;
}

export async function get<T>(path: string, signal?: AbortSignal): Promise<T> {
  const response = await request(path, signal === undefined ? {} : { signal });
  return (await response.json()) as T;
}

export async function send<T>(method: string, path: string, body?: unknown, extra: Record<string, string> = {}): Promise<T> {
  const init: RequestInit = { method, headers: extra };
  if (body !== undefined) {
    init.body = JSON.stringify(body);
    init.headers = { ...extra, "Content-Type": "application/json" };
  }
  const response = await request(path, init);
  const text = await response.text();
  return (text === "" ? null : JSON.parse(text)) as T;
}

/** Everything of a list, page by page. */
export async function all<T>(path: string, most = 2000): Promise<T[]> {
  const items: T[] = [];
  let cursor: string | null = null;
  do {
    const joint = path.includes("?") ? "&" : "?";
    const next: string = cursor === null ? "" : `&cursor=${encodeURIComponent(cursor)}`;
    const page: Page<T> = await get<Page<T>>(`${path}${joint}limit=500${next}`);
    items.push(...page.items);
    cursor = page.next;
  } while (cursor !== null && items.length < most);
  return items;
}

const tickets = new Map<string, { ticket: string; until: number }>();

/** The query that lets the browser itself open what lies below `path` ("" where no key is needed). */
export async function ticket(path: string): Promise<string> {
  if (key === null) return "";
  const known = tickets.get(path);
  if (known !== undefined && known.until > Date.now()) return `ticket=${known.ticket}`;
  const made = await send<{ ticket: string; expires_in_s: number }>("POST", "/v1/tickets", { path });
  tickets.set(path, { ticket: made.ticket, until: Date.now() + (made.expires_in_s - 60) * 1000 });
  return `ticket=${made.ticket}`;
}

export function withQuery(url: string, ...queries: string[]): string {
  const parts = queries.filter((query) => query !== "");
  return parts.length === 0 ? url : `${url}${url.includes("?") ? "&" : "?"}${parts.join("&")}`;
}

/** What to tell people about an error. */
export function troubleOf(error: unknown): { cause: string; hint: string } {
  if (error instanceof Problem) {
    const more = error.errors.filter((one) => !error.cause_.includes(one.message)).map((one) => `${one.where}: ${one.message}`);
    return { cause: [error.cause_, ...more].join("; "), hint: error.hint };
  }
  if (error instanceof TypeError) return { cause: "The server cannot be reached.", hint: "Check the connection; this page tries again." };
  return { cause: error instanceof Error ? error.message : String(error), hint: "" };
}
